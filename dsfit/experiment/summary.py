"""One row per method from the cells of a run, as data, as a terminal table and as Markdown."""

from __future__ import annotations

import math
import statistics
from collections.abc import Callable, Iterable
from typing import Any

from rich.console import RenderableType
from rich.table import Table

from dsfit.experiment import amortise_report, check_report, compare_render_report, race_report, render_report
from dsfit.experiment.files import number
from dsfit.experiment.report_tables import markdown_row


def rows(cells: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Summary of every method over all cells.

    Fields (seconds are of one thread; medians over cells unless said otherwise):
        excess_median, excess_worst: (N Var + |I|^2) / M* - 1 by quadrature; 0 is the limit of any single density.
        largest_weight: sup |F| / p in units of ∫|F|, the worst cell.
        predicted_over_measured: standard error that quadrature predicts over the measured one; 1 where both agree.
        seconds_per_sample: sample, density and integrand, at the largest sample count.
        seconds_to_1_percent: for one estimate with a relative RMSE of 1 %, without and with the fit's time
        (`..._with_fit`).
        fit_seconds: 0 for what needs no fit.
        speedup_over_uniform, speedup_over_best_mix: ratios of seconds_to_1_percent within a cell, without fit time.
        excess_below_best_mix: ratio of the best heuristic mix's excess to this method's, within a cell; `..._worst`
        is the least.
        pays_after: number of estimates at 1 % after which fit time is won back against the best mix (or uniform); inf
        if never.
    """
    if not cells or not cells[0].get("methods"):
        return []
    names = [method["name"] for method in cells[0]["methods"]]
    uniform = _first(cells[0], lambda m: m["kind"] == "uniform")
    best = _first(cells[0], lambda m: m.get("weights_rule") == "best")
    out = []
    for k, name in enumerate(names):
        mine = [cell["methods"][k] for cell in cells]

        def over(reference: int | None, key: str, mine: list[dict[str, Any]] = mine) -> list[float]:
            if reference is None:
                return []
            return [
                _ratio(number(c["methods"][reference][key]), number(m[key])) for c, m in zip(cells, mine, strict=True)
            ]

        seconds = [number(m["seconds_to_1_percent"]) for m in mine]
        fits = [number((m.get("fit") or {}).get("seconds", 0.0)) for m in mine]
        below = over(best, "excess")
        out.append(
            {
                "name": name,
                "kind": mine[0]["kind"],
                "excess_median": _median(number(m["excess"]) for m in mine),
                "excess_worst": _worst(number(m["excess"]) for m in mine),
                "largest_weight": _worst(number(m["largest_weight"]) for m in mine),
                "predicted_over_measured": _median(number(m["predicted_over_measured"]) for m in mine),
                "seconds_per_sample": _median(number(m["seconds_per_sample"]) for m in mine),
                "seconds_to_1_percent": _median(seconds),
                "seconds_to_1_percent_with_fit": _median(s + f for s, f in zip(seconds, fits, strict=True)),
                "fit_seconds": _median(fits),
                "speedup_over_uniform": _median(over(uniform, "seconds_to_1_percent")),
                "speedup_over_best_mix": _median(over(best, "seconds_to_1_percent")),
                "excess_below_best_mix": _median(below),
                "excess_below_best_mix_worst": min((x for x in below if not math.isnan(x)), default=math.nan),
                "pays_after": _median(_pays(cell, k) for cell in cells),
            }
        )
    return out


def _first(cell: dict[str, Any], wanted: Callable[[dict[str, Any]], bool]) -> int | None:
    return next((k for k, method in enumerate(cell["methods"]) if wanted(method)), None)


def _median(values: Iterable[float]) -> float:
    good = [v for v in values if not math.isnan(v)]
    return statistics.median(good) if good else math.nan


def _worst(values: Iterable[float]) -> float:
    good = [v for v in values if not math.isnan(v)]
    return max(good) if good else math.nan


def _ratio(a: float, b: float) -> float:
    if math.isnan(a) or math.isnan(b) or (math.isinf(a) and math.isinf(b)):
        return math.nan
    return a / b if b != 0 else math.inf


def _pays(cell: dict[str, Any], k: int) -> float:
    """Estimates at 1 % after which method k, fit included, is ahead of the fastest method that needs no fit."""
    free = [number(m["seconds_to_1_percent"]) for m in cell["methods"] if not m.get("fit")]
    own = cell["methods"][k]
    if not own.get("fit") or not free:
        return math.nan
    gain = min(free) - number(own["seconds_to_1_percent"])
    return math.ceil(number(own["fit"]["seconds"]) / gain) if gain > 0 else math.inf


# ---- as text ----

_COLUMNS: list[tuple[str, str, Callable[[dict[str, Any]], str]]] = [
    ("excess", "median", lambda r: _short(r["excess_median"])),
    ("excess", "worst", lambda r: _short(r["excess_worst"])),
    ("largest", "weight", lambda r: _short(r["largest_weight"])),
    ("error pred.", "/ measured", lambda r: _short(r["predicted_over_measured"])),
    ("time per", "sample", lambda r: _time(r["seconds_per_sample"])),
    ("time to", "1 % error", lambda r: _time(r["seconds_to_1_percent"])),
    ("fit", "time", lambda r: _time(r["fit_seconds"]) if r["fit_seconds"] else "-"),
    ("1 % error", "with fit", lambda r: _time(r["seconds_to_1_percent_with_fit"])),
    ("speed-up", "/ uniform", lambda r: _short(r["speedup_over_uniform"])),
    ("speed-up", "/ best mix", lambda r: _short(r["speedup_over_best_mix"])),
    ("excess below", "best mix", lambda r: _short(r["excess_below_best_mix"])),
]


def _short(value: float) -> str:
    value = number(value)
    if math.isnan(value):
        return "-"
    if math.isinf(value):
        return "inf"
    if value != 0 and not 1e-3 <= abs(value) < 1e4:
        return f"{value:.1e}"
    return f"{value:.3g}" if abs(value) < 1000 else f"{value:.0f}"


def _time(seconds: float) -> str:
    seconds = number(seconds)
    if math.isnan(seconds) or math.isinf(seconds):
        return "-" if math.isnan(seconds) else "inf"
    for unit, size in (("s", 1.0), ("ms", 1e-3), ("us", 1e-6)):
        if seconds >= size:
            return f"{seconds / size:.3g} {unit}"
    return f"{seconds / 1e-9:.3g} ns"


def terminal_table(result: dict[str, Any]) -> RenderableType:
    """The summary as a rich table."""
    if result["kind"] == "check":
        return check_report.terminal_table(result)
    if result["kind"] == "race":
        return race_report.terminal_table(result)
    if result["kind"] == "amortise":
        return amortise_report.terminal_table(result)
    if result["kind"] == "compare_render":
        return compare_render_report.terminal_table(result)
    if result["kind"] == "render":
        return render_report.terminal_table(result)
    if result["kind"] == "transmittance":
        return _transmittance_table(result)
    cells = result["cells"]
    table = Table(
        title=_title(result), title_justify="left", title_style="bold", caption=caption(result), caption_justify="left"
    )
    table.add_column("method", overflow="fold", min_width=12)
    for top, bottom, _ in _COLUMNS:
        table.add_column(f"{top}\n{bottom}", justify="right", no_wrap=True)
    for row in rows(cells):
        table.add_row(row["name"], *(text(row) for _, _, text in _COLUMNS))
    return table


_FIT_COLUMNS = ("centre_deg", "width_deg", "excess", "width_centred_deg", "excess_centred", "excess_cosine")
SHOWN_N = (1, 2, 5, 10, 20, 50)


def _transmittance_rows(result: dict[str, Any]) -> list[list[str]]:
    rows = []
    for cell in result["cells"]:
        fits = cell["fits"]
        chosen = [fit for fit in fits if fit["n"] in SHOWN_N] or fits
        rows += [[cell["label"], f"{fit['n']:g}", *(_short(fit[key]) for key in _FIT_COLUMNS)] for fit in chosen]
    return rows


def _transmittance_table(result: dict[str, Any]) -> Table:
    table = Table(title=_title(result), title_justify="left", title_style="bold")
    for name in ("fibre", "n", *_FIT_COLUMNS):
        table.add_column(
            name.replace("_deg", " / °").replace("_", "\n"), justify="left" if name == "fibre" else "right"
        )
    for row in _transmittance_rows(result):
        table.add_row(*row)
    return table


def markdown(result: dict[str, Any]) -> str:
    """The summary as a Markdown table, with the same numbers."""
    if result["kind"] == "check":
        return check_report.markdown(result)
    if result["kind"] == "race":
        return race_report.markdown(result)
    if result["kind"] == "amortise":
        return amortise_report.markdown(result)
    if result["kind"] == "compare_render":
        return compare_render_report.markdown(result)
    if result["kind"] == "render":
        return render_report.markdown(result)
    if result["kind"] == "transmittance":
        head = ["fibre", "n", *_FIT_COLUMNS]
        body = [head, ["---"] * len(head), *_transmittance_rows(result)]
        return f"# {_title(result)}\n\n" + "\n".join(map(markdown_row, body)) + "\n"
    lines = [f"# {_title(result)}", "", "| method | " + " | ".join(f"{a} {b}" for a, b, _ in _COLUMNS) + " |"]
    lines.append("|---|" + "---:|" * len(_COLUMNS))
    for row in rows(result["cells"]):
        lines.append(markdown_row([row["name"], *(text(row) for _, _, text in _COLUMNS)]))
    return "\n".join([*lines, "", caption(result), ""])


def _title(result: dict[str, Any]) -> str:
    count = len(result["cells"])
    what = "fibre" if result["kind"] == "transmittance" else "context"
    return f"{result['title'] or result['name']} ({count} {what}{'s' if count != 1 else ''})"


def caption(result: dict[str, Any]) -> str:
    """What the numbers are, in words."""
    estimate = result["config"]["estimate"]
    session = (result.get("provenance", {}).get("sessions") or [{}])[-1]
    workers = session.get("workers") or 1
    lines = [
        "Medians over the contexts, worst where it says so. Excess by quadrature: 0 is the limit of any density. "
        "Weights in units of their mean.",
        f"Times: {estimate['dtype']}, one thread per process, {workers} at once, "
        f"{estimate['repeats']} estimates in one batch; time to a relative RMSE of 1 %.",
    ]
    for row in rows(result["cells"]):
        if row["fit_seconds"] and not math.isnan(row["pays_after"]):
            fit = f"{row['name']}: its fit ({_time(row['fit_seconds'])})"
            count = f"is won back after {_short(row['pays_after'])} estimates at 1 % error (fastest without a fit)"
            lines.append(f"{fit} {count if math.isfinite(row['pays_after']) else 'is not won back'}.")
    return "\n".join(lines)
