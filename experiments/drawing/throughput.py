"""Draws rates by task and by number of directions, ratios to Mitsuba, and times against limits; tabulates all."""

from __future__ import annotations

from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from dsfit.experiment.plots.style import COLORS, MARKERS
from dsfit.figures import Data, Table
from dsfit.figures.page import Page
from experiments._throughput_bounds import bounds
from experiments._throughput_rows import (
    LABELS,
    TASKS,
    base,
    index,
    layout_of,
    libraries,
    measured,
    of_task,
    rate,
)
from experiments.drawing._throughput_tables import limits, rates, terms

WITH_CONTEXTS = {"prepare + eval": "prepare\n+ eval", "prepare + fused": "prepare\n+ all three"}
RATIO_NAMES = {**TASKS, "fused": "sample\n+ pdf + eval", **WITH_CONTEXTS}


def figures(data: Data, page: Page) -> dict[str, Figure]:
    """Four pictures; that of ratios only where Mitsuba was there."""
    record = data.record
    found = {}
    for name, height, draw in (("rates", 0.52, _bars), ("directions", 0.52, _curves), ("ratios", 0.55, _ratios),
                               ("limits", 0.55, _roofline)):  # fmt: skip
        if name == "ratios" and record["mitsuba"]["variant"] is None:
            continue
        found[name] = page.figure(height)
        axis = found[name].subplots()
        draw(axis, record)
        title = "threads, and contexts of directions" if name == "ratios" else None
        found[name].legend(loc="outside lower center", ncols=3, frameon=False, title=title)
    return found


def captions(data: Data) -> dict[str, str]:
    """What the figures show."""
    record = data.record
    load, peer = record["load"], record["mitsuba"]
    where = f"one thread bound to one of {load['cores']} cores"
    what = (
        f"Mitsuba {peer['version']} ({peer['variant']}) evaluates one fibre of four lobes, dsfit the same with roots "
        "and caustic, and scattering among fibres"
        if peer["variant"]
        else "Mitsuba was not there to compare with"
    )
    rows = [(task, *pair) for task in ("eval", "fused") if (pair := _pair(record, task, "all different", 1))]
    told = ", ".join(f"{rate(row) / rate(other):.2g} for {RATIO_NAMES[task]}" for task, row, other in rows)
    told = told.replace("\n", " ")
    found = {
        "rates": f"Million directions a second of processor time, {where}, each direction in a context of its own, for "
        "the number of directions a call that suits each contender best; compiled and prepared before. Bars: medians; "
        f"lines: 10th to 90th percentile of calls in turn. {what}.",
        "directions": f"The same rates against the number of directions a call, {where}, for eval alone (lines) and "
        "for sample, pdf and eval in one call (dashed). On the left the fixed cost of a call prevails, on the right "
        "results no longer fit the caches; larger calls of slow contenders are left out.",
        "limits": f"Left bars: time per direction that each resource would need by itself for the compiled kernel's "
        "operations, counted, at the rates of this machine, measured with small loops; right bars: time measured, "
        f"{where}, each direction in a context of its own. Measured times can be shorter than the sum, as resources "
        "work at once, and longer, where something waits.",
    }
    if peer["variant"]:
        found["ratios"] = (
            "Rate of the compiled kernel over that of Mitsuba for the same number of directions, the most that both "
            "did, by how directions share contexts and by threads; lines: from the 10th percentile of one over the "
            "90th of the other to the reverse; above 1 the kernel is ahead. Mitsuba's eval takes contexts in, the "
            "kernel's has them prepared unless “prepare” is named. One thread, contexts all different: "
            f"{told}."
        )
    return found


def _pair(record: dict[str, Any], task: str, layout: str, threads: int) -> tuple[Any, Any] | None:
    """Rows of the compiled kernel and of Mitsuba for the most directions that both did."""
    rows = index(record)
    both = [
        (row, other)
        for key, row in rows.items()
        if key[:3] == ("kernel, compiled", task, layout) and key[4] == threads
        if (other := base(record, rows, task, key[3], threads)) is not None
    ]
    return max(both, key=lambda pair: pair[0]["count"]) if both else None


def _bars(axis: Axes, record: dict[str, Any]) -> None:
    """Each contender with the number of directions that suits it best."""
    names = libraries(record)
    width = 0.8 / max(len(names), 1)
    for k, library in enumerate(names):
        label: str | None = LABELS[library]
        for j, task in enumerate(TASKS):
            row = max(of_task(record, library, task, layout_of(library)), key=rate, default=None)
            if row is None:
                continue
            value, ends = rate(row), [rate(row, key) for key in ("high", "low")]
            at = j + (k - (len(names) - 1) / 2) * width
            error = [[max(value - ends[0], 0.0)], [max(ends[1] - value, 0.0)]]
            axis.bar(at, value, width, color=COLORS[k], label=label, yerr=error, error_kw={"linewidth": 0.8})
            axis.annotate(f"{value:.2g}", (at, max(ends[1], value)), ha="center", va="bottom", fontsize=8)
            label = None
    axis.set_xticks(range(len(TASKS)), list(TASKS.values()))
    axis.set_yscale("log")
    axis.set_ylabel("million directions / s, one core")
    axis.margins(y=0.12)


def _curves(axis: Axes, record: dict[str, Any]) -> None:
    for k, library in enumerate(libraries(record)):
        for task, line, what in (("eval", "-", "eval"), ("fused", "--", "all three")):
            rows = of_task(record, library, task, layout_of(library))
            if rows:
                x, y = [row["count"] for row in rows], [rate(row) for row in rows]
                ends = [[rate(row, key) for row in rows] for key in ("high", "low")]
                label = f"{LABELS[library]}, {what}"
                axis.plot(x, y, line, color=COLORS[k], marker=MARKERS[k], markersize=4, label=label)
                axis.vlines(x, *ends, color=COLORS[k], linewidth=0.8)
    axis.set(xscale="log", yscale="log", xlabel="directions per call", ylabel="million directions / s, one core")
    axis.grid(True)


def _ratios(axis: Axes, record: dict[str, Any]) -> None:
    """Of the compiled kernel to Mitsuba, by task, layout and threads, each for the most directions that both did."""
    seen = {(row["threads"], row["layout"]) for row in record["rows"] if row["library"] == "kernel, compiled"}
    kinds = sorted(seen, key=lambda kind: (kind[0], kind[1] != "all different"))
    for k, (thread, layout) in enumerate(kinds):
        label: str | None = f"{thread} thread{'s' if thread > 1 else ''}, {layout.replace(' a c', ' per c')}"
        for j, task in enumerate(RATIO_NAMES):
            pair = _pair(record, task, layout, thread)
            if pair is None:
                continue
            row, other = pair
            value, at = rate(row) / rate(other), j + (k - (len(kinds) - 1) / 2) * 0.25
            ends = [rate(row, one) / rate(other, two) for one, two in (("high", "low"), ("low", "high"))]
            axis.bar(at, value, 0.25, color=COLORS[k], label=label)
            axis.vlines(at, *ends, color="black", linewidth=0.8)
            axis.annotate(
                f"{value:.2f}", (at, max(value, *ends)), (0, 1), textcoords="offset points", ha="center", fontsize=6
            )
            label = None
    axis.axhline(1.0, color="black", linewidth=0.8, zorder=0.5)
    axis.set_xticks(range(len(RATIO_NAMES)), list(RATIO_NAMES.values()))
    axis.set_ylabel("rate of the compiled kernel / Mitsuba")
    axis.margins(y=0.09)


def _roofline(axis: Axes, record: dict[str, Any]) -> None:
    counts = record.get("counts", {})
    tasks = [task for task in TASKS if task in counts]
    needed = {name for task in tasks for name, spent in bounds(record["machine"], counts[task]).items() if spent > 0}
    for j, task in enumerate(tasks):
        bottom = 0.0
        for k, (name, seconds) in enumerate(bounds(record["machine"], counts[task]).items()):
            if name not in needed:
                continue
            axis.bar(j - 0.2, 1e9 * seconds, 0.35, bottom=bottom, color=COLORS[k], label=None if j else name)
            bottom += 1e9 * seconds
        axis.bar(j + 0.2, measured(record, task), 0.35, color="#444444", label=None if j else "measured")
    axis.set_xticks(range(len(tasks)), [TASKS[task] for task in tasks])
    axis.set_ylabel("ns per direction, one core")
    axis.set_title("left: each resource by itself; right: measured, where they overlap")


def tables(data: Data) -> list[Table]:
    """Rates with ratios to Mitsuba, costs of terms, limits."""
    found = [rates(data.record), terms(data.record), limits(data.record)]
    return [table for table in found if table.rows]
