"""The C++ form of a kernel's functions."""

from __future__ import annotations

import ctypes
import functools
from ctypes import c_float, c_int32, c_int64, c_void_p
from pathlib import Path

import torch
from torch import Tensor

from dsfit.kernels.compiler import NoCompiler, built
from dsfit.kernels.functions import Functions
from dsfit.kernels.layout import FIELDS, GUIDE, LOBES, NEEDS, Layout
from dsfit.kernels.moments import Start

__all__ = ["NoCompiler", "library", "native_functions"]

_SOURCES = [Path(__file__).with_name(f"{name}.cpp") for name in ("vectors", "native", "prepare")]


def _structure(**fields: type) -> type[ctypes.Structure]:
    return type("Structure", (ctypes.Structure,), {"_fields_": list(fields.items())})


def _pointers(*names: str) -> dict[str, type]:
    return dict.fromkeys(names, c_void_p)


_Tables = _structure(**_pointers("constants", "records", "averages", "density", "cumulative", "guide"))
_Context = _structure(**_pointers("theta_r", "n", "v", "fields"), count=c_int64, sphere=c_float)
_Shading = _structure(
    **_pointers("theta_r", "n", "v", "u", "theta_i", "phi", "pdf", "value"),
    samples=c_int64,
    batch=c_int64,
    sphere=c_float,
)
_P, _N = c_void_p, c_int64
_ARGUMENTS = {
    "eval": (_P, _P, _N, _N, _P, _P, _P),
    "log_prob": (_P, _P, _N, _N, _P, _P, _P),
    "sample": (_P, _P, _N, _N, _P, _P, _P),
    "sample_eval": (_P, _P, _N, _N, _P, _P, _P, _P, _P),
    "fields": (_P, _P, _N, _N, _N, _P),
    "prepare": (_P, _P, _P, _P, _N, _P),
    "sort": (_P, _P, _P, _N, _P, _P),
    "shade": (_P, _P, _P, _P, _N),
}


def header(layout: Layout) -> str:
    """The layout as macros."""
    laws = [law if isinstance(law, int) else {"all": -1, "back": -2}[law] for law in layout.laws]
    width = -(-5 * layout.channels // 16) * 16
    macros = {
        "CHANNELS": layout.channels,
        "ROWS": layout.rows,
        "COLUMNS": layout.columns,
        "WIDTH": layout.width,
        "TABULATED": int(bool(layout.tabulated())),
        "KNOTS": layout.knots,
        "AVERAGES": width,
        "K": len(laws),
        "LAW_TABLES": layout.tables,
        "LAW_ROWS": layout.law_rows,
        "LAW_COLUMNS": layout.law_columns,
        "GUIDE": GUIDE,
        "HALF_BACK": int(layout.half_back),
        "POISSON": int(layout.poisson),
        "S_ANY": int(bool(layout.scattered)),
        "BACK_LOBE": int(layout.back_lobe),
    }
    for letter, terms in (("D", layout.direct), ("S", layout.scattered)):
        macros |= {f"{letter}_{name.upper()}": int(name in terms) for name in ("R", "TT", "TRT", "back")}
    offsets = layout.offsets()
    macros |= {f"O_{name.upper()}": offsets.get(name, 0) for name in ("TRT", *(f"{p}_scattered" for p in LOBES))}
    lines = [f"#define {name} {value}" for name, value in macros.items()]
    arrays = {"LAW": laws, "COMPONENT": layout.components}
    lines += [f"static constexpr int {name}[K] = {{{', '.join(map(str, x))}}};" for name, x in arrays.items()]
    return "\n".join([*lines, ""])


@functools.lru_cache(maxsize=64)
def library(layout: Layout) -> ctypes.CDLL:
    """The compiled library of one layout.

    Raises:
        NoCompiler: there is no compiler, or it fails.
    """
    code = built(header(layout) + "".join(path.read_text() for path in _SOURCES))
    for name, arguments in _ARGUMENTS.items():
        function = getattr(code, f"dsfit_{name}")
        function.argtypes, function.restype = arguments, c_int32 if name == "sort" else None
    return code


def native_functions(layout: Layout) -> Functions:
    """The functions of one layout in C++.

    Raises:
        NoCompiler: there is no compiler, or it fails.
    """
    code = library(layout)

    def call(function: ctypes._CFuncPtr, t: tuple, c: tuple, shape: torch.Size, *rest: Tensor) -> None:
        samples, batch = (1, shape[0]) if len(shape) == 1 else shape
        tables, context = _Tables(*t), _Context(*c)
        function(ctypes.addressof(tables), ctypes.addressof(context), samples, batch, *(x.data_ptr() for x in rest))

    def tables(*given: Tensor | None) -> tuple:
        return tuple(None if x is None else x.data_ptr() for x in given)

    def evaluated(constants, records, averages, context, theta_i, phi):  # noqa: ANN001, ANN202
        out = theta_i.new_empty(layout.channels, *theta_i.shape)
        c = (*tables(*context, None), len(context[0]), 0.0)
        t = tables(constants, records, averages, None, None, None)
        call(code.dsfit_eval, t, c, theta_i.shape, theta_i, phi, out)
        return out

    def log_prob(records, theta_r, mixture, theta_i, phi):  # noqa: ANN001, ANN202
        out = torch.empty_like(theta_i)
        c = (*tables(theta_r, None, None, mixture[0]), len(theta_r), float(mixture[1]))
        call(code.dsfit_log_prob, tables(None, records, None, None, None, None), c, theta_i.shape, theta_i, phi, out)
        return out

    def sample(theta_r, fields, laws, u):  # noqa: ANN001, ANN202
        shape = u.shape[:-1]
        theta_i, phi = u.new_empty(shape), u.new_empty(shape)
        c = (*tables(theta_r, None, None, fields), len(theta_r), 0.0)
        call(code.dsfit_sample, tables(None, None, None, *laws), c, shape, u, theta_i, phi)
        return theta_i, phi

    def sample_eval(constants, records, averages, laws, context, mixture, u):  # noqa: ANN001, ANN202
        shape = u.shape[:-1]
        theta_i, phi, pdf = (u.new_empty(shape) for _ in range(3))
        out = u.new_empty(layout.channels, *shape)
        c = (*tables(*context, mixture[0]), len(context[0]), float(mixture[1]))
        t = tables(constants, records, averages, *laws)
        call(code.dsfit_sample_eval, t, c, shape, u, theta_i, phi, pdf, out)
        return theta_i, phi, pdf, out

    def fields(theta_r, given, components, out):  # noqa: ANN001, ANN202
        given = [x.contiguous() for x in given]
        pointers = (c_void_p * 4)(*(x.data_ptr() for x in given))
        sizes = given[0].shape[1], len(theta_r), out.stride(1)
        code.dsfit_fields(theta_r.data_ptr(), ctypes.addressof(pointers), *sizes, out.data_ptr())

    def prepare(start: Start, theta_r: Tensor, n: Tensor, v: Tensor) -> Tensor:
        out = theta_r.new_empty(len(FIELDS), len(layout.components), len(theta_r))
        context = theta_r.data_ptr(), n.data_ptr(), v.data_ptr()
        code.dsfit_prepare(start.address, *context, len(theta_r), out.data_ptr())
        return out

    def sort(theta_r: Tensor, n: Tensor, v: Tensor, index: Tensor | None) -> dict[str, int] | None:
        counts = (c_int64 * 3)()
        context = theta_r.data_ptr(), n.data_ptr(), v.data_ptr()
        where = None if index is None else index.data_ptr()
        valid = code.dsfit_sort(*context, len(theta_r), where, ctypes.addressof(counts))
        return dict(zip(NEEDS, counts, strict=True)) if valid else None

    def shade(t, start, context, sphere, u, index, count, out):  # noqa: ANN001, ANN202
        r = _Shading(*tables(*context, u, *out), *u.shape[:2], sphere)
        t = _Tables(*tables(t.constants, t.records, t.averages, *t.laws))
        code.dsfit_shade(ctypes.addressof(t), start.address, ctypes.addressof(r), index.data_ptr(), count)

    return Functions(evaluated, log_prob, sample, sample_eval, fields, prepare, sort, shade)
