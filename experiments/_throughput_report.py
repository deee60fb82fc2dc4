"""Figure and table of what `throughput.py` measured; nothing is computed here but ratios."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from _throughput_bounds import bounds
from matplotlib.axes import Axes

from dsfit.experiment.plots.style import COLORS, MARKERS, new_figure, save, styled

TASKS = {"eval": "eval", "log_prob": "pdf", "sample": "sample", "fused": "sample + pdf + eval"}
LIBRARIES = ("Mitsuba", "kernel, compiled", "kernel, eager", "float64")
LABELS = {"Mitsuba": "Mitsuba 3 hair", "Mitsuba, scalar": "Mitsuba 3 hair, scalar", "float64": "dsfit, float64"}
KEYS = tuple[str, str, str, int, int]


def index(data: dict[str, Any]) -> dict[KEYS, dict[str, Any]]:
    """Rows by library, task, layout, directions as asked for (a power of ten), threads."""
    return {
        (row["library"], row["task"], row["layout"], _asked(row), row["threads"]): row for row in data["rows"]
    }


def clock(row: dict[str, Any]) -> dict[str, float]:
    """Seconds of a call: on the processor for one thread, which others hardly disturb, else wall time."""
    return row["processor"] if row["threads"] == 1 else row["wall"]


def rate(row: dict[str, Any], which: str = "median") -> float:
    """Million directions per second."""
    return row["count"] / max(clock(row)[which], 1e-12) / 1e6


def _asked(row: dict[str, Any]) -> int:
    return 10 ** round(float(np.log10(max(row["count"], 1)))) if row["task"] != "prepare" else row["count"]


def mitsuba(data: dict[str, Any]) -> str:
    """Name of Mitsuba's rows that others are compared with."""
    names = {row["library"] for row in data["rows"]}
    return "Mitsuba" if "Mitsuba" in names else "Mitsuba, scalar"


def table(data: dict[str, Any]) -> str:
    """Markdown: million directions per second, ratios to Mitsuba, costs of terms, limits."""
    parts = [_heading(data), _rates(data), _terms(data), _limits(data)]
    return "\n\n".join(part for part in parts if part) + "\n"


def _heading(data: dict[str, Any]) -> str:
    machine, load, theirs = data["provenance"]["machine"], data["load"], data["mitsuba"]
    return (
        f"{machine['processor']}, {load['cores']} cores; load {load['before']:.1f} before, {load['after']:.1f} after "
        f"(1 is one busy core); {data['seconds']:.0f} s. Mitsuba {theirs['version']}, {theirs['variant']} "
        f"({theirs['reason']}). Kernels: "
        + "; ".join(f"{name}: {backend}" for name, backend in data.get("backends", {}).items())
        + ". Million directions per second, of processor time for one thread, of wall time for two: median (10-90 %), "
        "and the ratio to Mitsuba for the same directions and threads."
    )


def _rates(data: dict[str, Any]) -> str:
    rows = index(data)
    columns = sorted({(key[4], key[3]) for key, row in rows.items() if row["task"] != "prepare"})
    titles = [f"{count:.0e}".replace("e+0", "e") + (f", {threads} threads" if threads > 1 else "")
              for threads, count in columns]  # fmt: skip
    lines = ["| task | library | contexts | " + " | ".join(titles) + " |", "|---|---|---|" + "---:|" * len(columns)]
    seen = dict.fromkeys((row["task"], row["library"], row["layout"]) for row in data["rows"])
    order = {task: k for k, task in enumerate([*TASKS, "prepare + eval", "prepare + fused", "to_angles"])}
    for task, library, layout in sorted(seen, key=lambda key: (order.get(key[0], 99), key[1] != mitsuba(data))):
        if task in order:
            cells = [_cell(data, rows, library, task, layout, *column) for column in columns]
            lines.append(f"| {TASKS.get(task, task)} | {LABELS.get(library, library)} | {layout} | "
                         + " | ".join(cells) + " |")  # fmt: skip
    return "\n".join(lines)


def _cell(data: dict, rows: dict, library: str, task: str, layout: str, threads: int, count: int) -> str:
    row = rows.get((library, task, layout, count, threads))
    if row is None:
        return ""
    text = f"{rate(row):.3g} ({rate(row, 'high'):.3g}-{rate(row, 'low'):.3g})"
    base = _base(data, rows, task, count, threads)
    return text if base is None or base is row else f"{text} x{rate(row) / rate(base):.2f}"


def _base(data: dict, rows: dict, task: str, count: int, threads: int) -> dict[str, Any] | None:
    """Mitsuba's row for this task; its eval takes contexts in, so it is what `prepare + eval` is compared with too."""
    name = mitsuba(data)
    layout = "all different" if name == "Mitsuba" else "one context"
    return rows.get((name, task.removeprefix("prepare + "), layout, count, threads))


def _terms(data: dict[str, Any]) -> str:
    """Nanoseconds per direction of the kernel's terms, one thread."""
    rows = [row for row in data["rows"] if row["threads"] == 1 and row["library"] == "kernel, compiled"]
    if not rows:
        return ""
    largest = max(row["count"] for row in rows if row["task"] == "eval")
    lines = ["| kernel, compiled, one thread | contexts | ns per direction (prepare: per context) |", "|---|---|---:|"]
    for row in rows:
        if row["count"] == largest or (row["task"] == "prepare" and row["count"] >= largest / 16):
            lines.append(f"| {row['task']} | {row['layout']} | {1e3 / rate(row):.1f} |")
    return "\n".join(lines)


def _limits(data: dict[str, Any]) -> str:
    counts = data.get("counts")
    if not counts:
        return ""
    names = list(bounds(data["machine"], {}))
    lines = ["| task | " + " | ".join(f"{name}: count, ns" for name in names) + " | sum, ns | measured, ns |",
             "|---|" + "---:|" * (len(names) + 2)]  # fmt: skip
    for task, count in counts.items():
        found = bounds(data["machine"], count)
        count = {**count, "look-ups": count.get("lines") or count.get("gathers", 0)}
        cells = [f"{count.get(name, 0):.3g}, {1e9 * found[name]:.2g}" for name in names]
        lines.append(f"| {task} | " + " | ".join(cells) + f" | {1e9 * sum(found.values()):.3g} | "
                     f"{_measured(data, task):.3g} |")  # fmt: skip
    return "\n".join(lines)


def _measured(data: dict[str, Any], task: str) -> float:
    """Nanoseconds per direction of the compiled kernel for the most directions, each with its own context, as the
    limits are counted; nan if it was not timed."""
    key = "kernel, compiled", task, "all different", 1
    rows = [row for row in data["rows"] if (row["library"], row["task"], row["layout"], row["threads"]) == key]
    return 1e3 / rate(max(rows, key=lambda row: row["count"])) if rows else float("nan")


def figure(data: dict[str, Any], folder: Path) -> list[Path]:
    """Rates by task; rates by number of directions; ratios to Mitsuba; time against limits."""
    with styled():
        sheet = new_figure(10.0, 7.2)
        axes = sheet.subplots(2, 2)
        _bars(axes[0, 0], data)
        _curves(axes[0, 1], data)
        _ratios(axes[1, 0], data)
        _roofline(axes[1, 1], data)
        return save(sheet, folder, "throughput")


def _best(data: dict[str, Any], library: str, task: str, layout: str, threads: int = 1) -> dict[str, Any] | None:
    """The row with the number of directions that suits it best."""
    key = (library, task, layout, threads)
    rows = [row for row in data["rows"] if (row["library"], row["task"], row["layout"], row["threads"]) == key]
    return max(rows, key=rate, default=None)


def _libraries(data: dict[str, Any]) -> list[str]:
    names = {row["library"] for row in data["rows"]}
    return [name for name in (mitsuba(data), *LIBRARIES[1:]) if name in names]


def _layout(library: str) -> str:
    return "one context" if library == "Mitsuba, scalar" else "all different"


def _bars(axis: Axes, data: dict[str, Any]) -> None:
    libraries = _libraries(data)
    width = 0.8 / len(libraries)
    for k, library in enumerate(libraries):
        for j, task in enumerate(TASKS):
            row = _best(data, library, task, _layout(library))
            if row is None:
                continue
            value, ends = rate(row), [rate(row, key) for key in ("high", "low")]
            at = j + (k - (len(libraries) - 1) / 2) * width
            label = LABELS.get(library, library) if j == 0 else None
            axis.bar(at, value, width, color=COLORS[k], label=label,
                     yerr=[[value - ends[0]], [ends[1] - value]], error_kw={"linewidth": 0.8})  # fmt: skip
            axis.annotate(f"{value:.3g}", (at, ends[1]), ha="center", va="bottom", fontsize=6.5)
    axis.set_xticks(range(len(TASKS)), list(TASKS.values()))
    axis.set_yscale("log")
    axis.set_ylabel("million directions / s, one core")
    axis.set_title("each direction its own context, prepared before; best number of directions")
    axis.margins(y=0.12)
    axis.legend(frameon=False, ncols=2, loc="upper center", bbox_to_anchor=(0.5, -0.1))


def _curves(axis: Axes, data: dict[str, Any]) -> None:
    for k, library in enumerate(_libraries(data)):
        for task, line in (("eval", "-"), ("fused", "--")):
            rows = sorted(
                (row["count"], rate(row))
                for row in data["rows"]
                if (row["library"], row["task"], row["threads"], row["layout"]) == (library, task, 1, _layout(library))
            )
            if rows:
                label = LABELS.get(library, library) if task == "eval" else None
                axis.plot(*zip(*rows, strict=True), line, color=COLORS[k], marker=MARKERS[k], markersize=4, label=label)
    axis.set_xscale("log")
    axis.set_yscale("log")
    axis.set_xlabel("directions per call")
    axis.set_ylabel("million directions / s, one core")
    axis.grid(True)
    axis.set_title("solid: eval; dashed: sample + pdf + eval")
    axis.legend(frameon=False, fontsize=7, ncols=2, loc="upper center", bbox_to_anchor=(0.5, -0.18))


def _ratios(axis: Axes, data: dict[str, Any]) -> None:
    """Of the compiled kernel to Mitsuba, by task, layout and threads, each for the most directions that both did."""
    rows = index(data)
    seen = {(row["threads"], row["layout"]) for row in data["rows"] if row["library"] == "kernel, compiled"}
    kinds = sorted(seen, key=lambda kind: (kind[0], kind[1] != "all different"))
    tasks = ["eval", "log_prob", "sample", "fused", "prepare + eval", "prepare + fused"]
    for k, (thread, layout) in enumerate(kinds):
        for j, task in enumerate(tasks):
            both = [
                (row, base)
                for key, row in rows.items()
                if key[:3] == ("kernel, compiled", task, layout) and key[4] == thread
                if (base := _base(data, rows, task, key[3], thread)) is not None
            ]
            if not both:
                continue
            row, base = max(both, key=lambda pair: pair[0]["count"])
            value = rate(row) / rate(base)
            label = f"{thread} thread{'s' if thread > 1 else ''}, {layout}" if j == 0 else None
            axis.bar(j + (k - (len(kinds) - 1) / 2) * 0.2, value, 0.2, color=COLORS[k], label=label)
    axis.axhline(1.0, color="black", linewidth=0.8)
    names = [TASKS.get(task, task).replace(" + ", " +\n") for task in tasks]
    axis.set_xticks(range(len(tasks)), names, fontsize=7)
    axis.set_ylabel("compiled kernel / Mitsuba")
    axis.set_title("above 1 the kernel is faster; most directions that both did")
    axis.legend(frameon=False, fontsize=7, ncols=2, loc="upper center", bbox_to_anchor=(0.5, -0.2))


def _roofline(axis: Axes, data: dict[str, Any]) -> None:
    counts = data.get("counts", {})
    tasks = [task for task in TASKS if task in counts]
    for j, task in enumerate(tasks):
        bottom = 0.0
        for k, (name, seconds) in enumerate(bounds(data["machine"], counts[task]).items()):
            axis.bar(j - 0.2, 1e9 * seconds, 0.35, bottom=bottom, color=COLORS[k], label=name if j == 0 else None)
            bottom += 1e9 * seconds
        axis.bar(j + 0.2, _measured(data, task), 0.35, color="#444444", label="measured" if j == 0 else None)
    axis.set_xticks(range(len(tasks)), [TASKS[task] for task in tasks])
    axis.set_ylabel("ns per direction, one core")
    axis.set_title("compiled kernel: limits by resource, and measured")
    axis.legend(frameon=False, fontsize=7)
