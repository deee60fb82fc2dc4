"""Tables as C++ source, put into the template."""

from __future__ import annotations

import hashlib
import re
from pathlib import Path

import numpy as np

from dsfit.errors import InputError
from dsfit.export.tables import Tables

STRIDE = 16
"""Columns between two numbers of the tables that bracket an azimuth."""
_FOLDER = Path(__file__).parent
_WIDTH = 118
_RESERVED = frozenset(
    "alignas alignof and and_eq asm auto bitand bitor bool break case catch char char16_t char32_t char8_t class compl "
    "concept const const_cast consteval constexpr constinit continue co_await co_return co_yield decltype default "
    "delete do double dynamic_cast else enum explicit export extern false float for friend goto if inline int long "
    "main mutable namespace new noexcept not not_eq nullptr operator or or_eq private protected public register "
    "reinterpret_cast requires return short signed sizeof static static_assert static_cast std struct switch template "
    "this thread_local throw true try typedef typeid typename union unsigned using virtual void volatile wchar_t while "
    "xor xor_eq".split()
)


def source(name: str) -> str:
    """One of the C++ files of this package."""
    return (_FOLDER / name).read_text()


def check_namespace(name: str) -> str:
    """The name of a C++ namespace.

    Raises:
        InputError: it is none.
    """
    pattern = r"[A-Za-z][A-Za-z0-9]*(_[A-Za-z0-9]+)*"
    if not isinstance(name, str) or not re.fullmatch(pattern, name) or name in _RESERVED:
        allowed = "letters, digits and single underscores, starting with a letter; no keyword of C++"
        raise InputError("namespace", name, allowed)
    return name


def header_text(tables: Tables, namespace: str, comment: list[str], known: list[tuple[float, ...]]) -> str:
    """The whole header; `known` are rows theta_r, n, v, albedo by channel."""
    body = source("template.h")
    numbers = "\n".join(_tables(tables))
    content = hashlib.sha256((body + numbers).encode()).hexdigest()
    parts = {
        "CONTENT": f"content_{content[:16]}",
        "GUARD": f"DSFIT_{check_namespace(namespace).upper()}_H",
        "NAMESPACE": namespace,
        "CHANNELS": str(len(tables.sigma_a)),
        "TABLES": numbers,
        "KNOWN": _known(known),
    }
    for name, text in parts.items():
        body = body.replace(f"@{name}@", text)
    lines = [*comment, "", f"SHA-256 of what follows: {hashlib.sha256(body.encode()).hexdigest()}"]
    return "".join(f"// {line}".rstrip() + "\n" for line in lines) + body


def _tables(t: Tables) -> list[str]:
    spread, trt = t.spread.values, t.trt.values
    sums = [t.law_sums(law, STRIDE) for law in t.laws]
    numbers = {
        "components": len(t.components),
        "near_lobes": t.near.shape[2],
        "far_lobes": t.far_energy.shape[2],
        "moment_rows": len(t.near),
        "levels": len(t.depths),
        "value_rows": trt.shape[0],
        "columns": trt.shape[1],
        "spread_columns": spread.shape[1],
        "knots": len(t.averages),
        "law_count": len(t.laws),
        "law_rows": len(t.laws[0]),
        "stride": STRIDE,
        "layers": len(t.layers),
        "widest": max(max(weight.shape) for _, weight in t.layers),
    }
    floats = {
        "eta": t.eta,
        "lobe_constant": t.lobe_constant,
        "back_factor": t.back_factor,
        "log_density": t.log_density,
        "scattered_back": t.scattered_back,
        "log_lobes": t.log_lobes,
        "sphere": t.sphere,
        "broad_log_energy": -4.60517019,
        "broad_log_width": -0.510825624,
        "least_width": 1e-5,
        "most_width": 1e2,
    }
    sizes = [len(t.layers[0][1]), *(len(bias) for bias, _ in t.layers)]
    starts = np.cumsum([0, *(law.size for law in t.laws)])[:-1]
    network = np.concatenate([x.ravel() for layer in t.layers for x in layer])
    return [
        *(f"inline constexpr int {name} = {value};" for name, value in numbers.items()),
        f"inline constexpr bool half_back = {str(t.half_back).lower()}, poisson = {str(t.poisson).lower()};",
        *(f"inline constexpr float {name} = {_float(value)};" for name, value in floats.items()),
        *_array("float", "alpha", t.alpha),
        *_array("float", "variance", t.variance),
        *_array("float", "sigma_a", t.sigma_a),
        "// law of azimuth of each component",
        *_array("int", "laws", np.array(t.components)),
        "// N_TRT [value_rows][columns][channels], and what each row is multiplied by",
        *_array("std::uint16_t", "trt", trt),
        *_array("float", "trt_scale", t.trt.scale),
        "// N^G [value_rows][spread_columns][1 + 2 channels], and what each row is multiplied by",
        *_array("std::uint16_t", "spread", spread),
        *_array("float", "spread_scale", t.spread.scale),
        "// log a_f, beta_f^2, A_b, Delta_b, sigma_b^2 [knots][5][channels]",
        *_array("float", "average_table", t.averages),
        "// densities of |phi|, per law [law_rows][columns]; what each row is multiplied by; their CDFs every `stride`",
        *_array("int", "law_columns", np.array([law.shape[1] for law in t.laws])),
        *_array("int", "law_start", starts),
        *_array("std::uint16_t", "law_table", np.concatenate([law.ravel() for law in t.laws])),
        *_array("float", "law_scale", t.law_scale()),
        *_array("int", "sums_start", np.cumsum([0, *(x.size for x in sums)])[:-1]),
        *_array("std::uint32_t", "law_sums", np.concatenate([x.ravel() for x in sums])),
        "// moments of the lobes: direct light [moment_rows][4][near_lobes]; scattered light, log energies",
        "// [moment_rows][levels][far_lobes], and modes, log widths below, above [moment_rows][levels][3][far_lobes]",
        *_array("float", "near_table", t.near),
        *_array("float", "depths", t.depths),
        *_array("float", "far_energy", t.far_energy),
        *_array("std::uint16_t", "far_shape", t.far_shape),
        *_array("float", "shape_start", t.shape_start),
        *_array("float", "shape_step", t.shape_step),
        *_array("int", "sizes", np.array(sizes)),
        *_array("float", "network", network),
    ]


def _array(kind: str, name: str, values: np.ndarray) -> list[str]:
    """A constexpr array, filled row by row; floats in the fewest digits that give them back."""
    flat = values.ravel()
    words = [_float(x) for x in flat] if kind == "float" else [str(x) for x in flat.tolist()]
    lines, line, length = [], [], 0
    for word in words:
        if length + len(word) + 1 > _WIDTH:
            lines.append(",".join(line) + ",")
            line, length = [], 0
        line.append(word)
        length += len(word) + 1
    lines.append(",".join(line) + "};")
    return [f"inline constexpr {kind} {name}[{flat.size}] = {{", *lines]


def _float(value: float) -> str:
    """The shortest decimal that a C++ compiler reads as this float32."""
    number = np.float32(value)
    if not np.isfinite(number):
        raise InputError("tables", float(value), "finite numbers")
    text = str(number).replace("e-0", "e-").replace("e+0", "e").replace("e+", "e")
    text = re.sub(r"^(-?)0\.(?=\d*[1-9])", r"\1.", text)
    text = re.sub(r"\.0$", ".", text)
    return text + "f"


def _known(rows: list[tuple[float, ...]]) -> str:
    lines = []
    for row in rows:
        context, albedo = (", ".join(_float(x) for x in part) for part in (row[:3], row[3:]))
        lines.append(f"    {{{context}, {{{{{albedo}}}}}}},")
    start = f"inline constexpr std::array<Known, {len(rows)}> known = {{{{"
    return "\n".join([start, *lines, "}};"])
