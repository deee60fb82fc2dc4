"""What an amortising experiment comes to: one row per fibre, on a terminal and in Markdown."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

from rich.table import Table

from dsfit.experiment.files import number
from dsfit.experiment.report_tables import markdown_row


def _short(value: Any) -> str:
    value = number(value)
    if math.isnan(value):
        return "-"
    return f"{value:.1e}" if 0 < abs(value) < 1e-3 else f"{value:.3g}"


def _where(cell: dict[str, Any]) -> str:
    where = cell["held_out"]["where"]
    return f"θr {where['theta_r_deg']:.0f}°, n {where['n']:g}, v {where['v']:.2g}"


_COLUMNS: list[tuple[str, str, Callable[[dict[str, Any]], str]]] = [
    ("untrained", "median", lambda c: _short(c["start"]["median"])),
    ("untrained", "99 %", lambda c: _short(c["start"]["p99"])),
    ("excess", "median", lambda c: _short(c["held_out"]["median"])),
    ("excess", "95 %", lambda c: _short(c["held_out"]["p95"])),
    ("excess", "99 %", lambda c: _short(c["held_out"]["p99"])),
    ("excess", "worst", lambda c: _short(c["held_out"]["worst"])),
    ("worst", "at", _where),
    ("largest", "weight", lambda c: _short(c["held_out"]["largest_weight"])),
    ("tables", "/ s", lambda c: _short(c["training"]["seconds"]["proposal"])),
    ("targets", "/ s", lambda c: _short(c["training"]["seconds"]["targets"])),
    ("training", "/ s", lambda c: _short(c["training"]["seconds"]["training"])),
]


def caption(result: dict[str, Any]) -> str:
    """What the numbers are, in words."""
    cells = result["cells"]
    count, steps = cells[0]["held_out"]["contexts"], cells[0]["training"]["steps"]
    checked = [number(c["held_out"]["disagreement"]) for c in cells]
    worst = max((x for x in checked if not math.isnan(x)), default=math.nan)
    against = f" Against adaptive cubature: within {worst:.1%}." if not math.isnan(worst) else ""
    return (
        f"Excess of {count} contexts that were not trained on, by quadrature: 0 is the limit of any density.{against} "
        f"Trained on {cells[0]['training']['contexts']} contexts for {steps} steps; one thread per process."
    )


def _title(result: dict[str, Any]) -> str:
    count = len(result["cells"])
    return f"{result['title'] or result['name']} ({count} fibre{'s' if count != 1 else ''})"


def terminal_table(result: dict[str, Any]) -> Table:
    """One row per fibre."""
    title = {"title": _title(result), "title_justify": "left", "title_style": "bold"}
    table = Table(**title, caption=caption(result), caption_justify="left")
    table.add_column("fibre", overflow="fold", min_width=8)
    for top, bottom, _ in _COLUMNS:
        table.add_column(f"{top}\n{bottom}", justify="right")
    for cell in result["cells"]:
        table.add_row(cell["label"], *(text(cell) for _, _, text in _COLUMNS))
    return table


def markdown(result: dict[str, Any]) -> str:
    """The same numbers as a Markdown table, and what happens beyond the contexts of the training."""
    lines = [f"# {_title(result)}", "", "| fibre | " + " | ".join(f"{a} {b}" for a, b, _ in _COLUMNS) + " |"]
    lines.append("|---|" + "---:|" * len(_COLUMNS))
    lines += [markdown_row([c["label"], *(text(c) for _, _, text in _COLUMNS)]) for c in result["cells"]]
    lines += ["", caption(result), "", "Beyond the training (- where no light is left in float64):", ""]
    places = [(b["theta_r_deg"], b["n"]) for b in result["cells"][0]["beyond"]]
    lines.append("| fibre | " + " | ".join(f"{t:.4g}°, n {n:g}" for t, n in places) + " |")
    lines.append("|---|" + "---:|" * len(places))
    for cell in result["cells"]:
        lines.append(markdown_row([cell["label"], *(_short(b["excess"]) for b in cell["beyond"])]))
    return "\n".join([*lines, ""])
