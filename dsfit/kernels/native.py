"""The C++ form of a kernel's functions, compiled for this machine at first use and kept in the user's cache."""

from __future__ import annotations

import ctypes
import functools
import hashlib
import os
import platform
import shutil
import subprocess
import tempfile
from pathlib import Path

import torch
from torch import Tensor

from dsfit.kernels.contexts import mixture_fields
from dsfit.kernels.functions import Functions
from dsfit.kernels.layout import BLOCK, GUIDE, LOBES, Layout

_FLAGS = ("-std=c++17", "-O3", "-march=native", "-fno-math-errno", "-fno-trapping-math", "-ffp-contract=fast",
          "-Wno-psabi", "-shared", "-fPIC")  # fmt: skip
_SOURCE = Path(__file__).with_name("native.cpp")


class NoCompiler(RuntimeError):
    """No C++ compiler that can build the kernel."""


_TABLES = ("constants", "records", "averages", "density", "cumulative", "guide")


class _Tables(ctypes.Structure):
    _fields_ = [(name, ctypes.c_void_p) for name in _TABLES]


class _Context(ctypes.Structure):
    _fields_ = [(name, ctypes.c_void_p) for name in ("theta_r", "n", "v", "fields")]
    _fields_ += [("count", ctypes.c_int64), ("sphere", ctypes.c_float)]


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
        "S_ANY": int(bool(layout.scattered)),
    }
    for letter, terms in (("D", layout.direct), ("S", layout.scattered)):
        macros |= {f"{letter}_{name.upper()}": int(name in terms) for name in ("R", "TT", "TRT", "back")}
    offsets = layout.offsets()
    macros |= {f"O_{name.upper()}": offsets.get(name, 0) for name in ("TRT", *(f"{p}_scattered" for p in LOBES))}
    lines = [f"#define {name} {value}" for name, value in macros.items()]
    return "\n".join([*lines, f"static constexpr int LAW[K] = {{{', '.join(map(str, laws))}}};", ""])


@functools.lru_cache(maxsize=64)
def library(layout: Layout) -> ctypes.CDLL:
    """The compiled library of one layout.

    Raises:
        NoCompiler: there is no compiler, or it fails.
    """
    compiler = os.environ.get("CXX") or shutil.which("g++") or shutil.which("clang++")
    if not compiler:
        raise NoCompiler("no C++ compiler found (g++, clang++ or $CXX)")
    source = header(layout) + _SOURCE.read_text()
    key = hashlib.sha256("\0".join([source, *_FLAGS, compiler, _machine()]).encode()).hexdigest()[:24]
    path = _cache() / f"{key}.so"
    if not path.exists():
        _compile(compiler, source, path)
    try:
        return ctypes.CDLL(str(path))
    except OSError as error:
        raise NoCompiler(f"the compiled kernel does not load: {error}") from None


def _compile(compiler: str, source: str, path: Path) -> None:
    with tempfile.TemporaryDirectory(dir=path.parent) as folder:
        text, made = Path(folder) / "kernel.cpp", Path(folder) / "kernel.so"
        text.write_text(source)
        command = [compiler, *_FLAGS, str(text), "-o", str(made)]
        try:
            done = subprocess.run(command, capture_output=True, text=True, check=False)
        except OSError as error:
            raise NoCompiler(f"{compiler}: {error}") from None
        if done.returncode:
            raise NoCompiler(f"{compiler} failed: {done.stderr.strip()[-500:]}")
        os.replace(made, path)


def _machine() -> str:
    """What -march=native depends on."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.platform() + platform.processor()
    return next((line for line in lines if line.startswith(("flags", "Features"))), "") + platform.machine()


def _cache() -> Path:
    base = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "dsfit" / "kernels"
    try:
        base.mkdir(parents=True, exist_ok=True)
    except OSError:
        base = Path(tempfile.gettempdir()) / f"dsfit-kernels-{os.getuid()}"
        base.mkdir(mode=0o700, exist_ok=True)
    return base


def native_functions(layout: Layout) -> Functions:
    """The functions of one layout in C++.

    Raises:
        NoCompiler: there is no compiler, or it fails.
    """
    code = library(layout)

    def call(name: str, t: tuple, c: tuple, shape: torch.Size, *rest: Tensor) -> None:
        samples, batch = (1, shape[0]) if len(shape) == 1 else shape
        tables, context = _Tables(*t), _Context(*c)
        function = getattr(code, name)
        pointers = [ctypes.c_void_p(x.data_ptr()) for x in rest]
        function(ctypes.byref(tables), ctypes.byref(context), ctypes.c_int64(samples), ctypes.c_int64(batch), *pointers)

    def tables(*given: Tensor | None) -> tuple:
        return tuple(None if x is None else x.data_ptr() for x in given)

    def evaluated(constants, records, averages, context, theta_i, phi):  # noqa: ANN001, ANN202
        out = theta_i.new_empty(layout.channels, *theta_i.shape)
        c = (*tables(*context, None), len(context[0]), 0.0)
        call("dsfit_eval", tables(constants, records, averages, None, None, None), c, theta_i.shape, theta_i, phi, out)
        return out

    def log_prob(records, theta_r, mixture, theta_i, phi):  # noqa: ANN001, ANN202
        out = torch.empty_like(theta_i)
        c = (*tables(theta_r, None, None, mixture[0]), len(theta_r), float(mixture[1]))
        call("dsfit_log_prob", tables(None, records, None, None, None, None), c, theta_i.shape, theta_i, phi, out)
        return out

    def sample(theta_r, fields, laws, u):  # noqa: ANN001, ANN202
        shape = u.shape[:-1]
        theta_i, phi = u.new_empty(shape), u.new_empty(shape)
        c = (*tables(theta_r, None, None, fields), len(theta_r), 0.0)
        call("dsfit_sample", tables(None, None, None, *laws), c, shape, u, theta_i, phi)
        return theta_i, phi

    def sample_eval(constants, records, averages, laws, context, mixture, u):  # noqa: ANN001, ANN202
        shape = u.shape[:-1]
        theta_i, phi, pdf = (u.new_empty(shape) for _ in range(3))
        out = u.new_empty(layout.channels, *shape)
        c = (*tables(*context, mixture[0]), len(context[0]), float(mixture[1]))
        t = tables(constants, records, averages, *laws)
        call("dsfit_sample_eval", t, c, shape, u, theta_i, phi, pdf, out)
        return theta_i, phi, pdf, out

    def fields(theta_r, given, components, out):  # noqa: ANN001, ANN202
        if len(theta_r) < BLOCK:
            out.copy_(mixture_fields(theta_r, given, components))
            return
        given = [x.contiguous() for x in given]
        pointers = (ctypes.c_void_p * 4)(*(x.data_ptr() for x in given))
        which = (ctypes.c_int32 * len(components))(*components)
        sizes = (ctypes.c_int64(x) for x in (given[0].shape[1], len(theta_r), out.stride(1)))
        code.dsfit_fields(ctypes.c_void_p(theta_r.data_ptr()), pointers, which, *sizes, ctypes.c_void_p(out.data_ptr()))

    return Functions(evaluated, log_prob, sample, sample_eval, fields)
