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
        + ". Million directions per second: median (10-90 %); ratio to Mitsuba for the same directions and threads."
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
    low, high = row["count"] / row["seconds_90"] / 1e6, row["count"] / row["seconds_10"] / 1e6
    text = f"{row['per_second'] / 1e6:.3g} ({low:.3g}-{high:.3g})"
    base = _base(data, rows, task, count, threads)
    return text if base is None or base is row else f"{text} x{row['per_second'] / base['per_second']:.2f}"


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
            lines.append(f"| {row['task']} | {row['layout']} | {1e9 * row['seconds'] / row['count']:.1f} |")
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
        cells = [f"{count.get(name, 0):.3g}, {1e9 * found[name]:.2g}" for name in names]
        lines.append(f"| {task} | " + " | ".join(cells) + f" | {1e9 * sum(found.values()):.3g} | "
                     f"{_measured(data, task):.3g} |")  # fmt: skip
    return "\n".join(lines)


def _measured(data: dict[str, Any], task: str) -> float:
    """Nanoseconds per direction of the compiled kernel at the count that suits it best; nan if it was not timed."""
    found = [
        1e9 * row["seconds"] / row["count"]
        for row in data["rows"]
        if (row["library"], row["task"], row["threads"]) == ("kernel, compiled", task, 1)
    ]
    return min(found, default=float("nan"))


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


def _shown(data: dict[str, Any]) -> int:
    """The largest number of directions that all libraries were timed with."""
    counts = {row["library"]: set() for row in data["rows"] if row["library"] in LIBRARIES and row["threads"] == 1}
    for row in data["rows"]:
        if row["library"] in counts and row["task"] == "eval" and row["layout"] == "all different":
            counts[row["library"]].add(_asked(row))
    return max(set.intersection(*(found for found in counts.values() if found)))


def _libraries(data: dict[str, Any]) -> list[str]:
    names = {row["library"] for row in data["rows"]}
    return [name for name in (mitsuba(data), *LIBRARIES[1:]) if name in names]


def _layout(library: str) -> str:
    return "one context" if library == "Mitsuba, scalar" else "all different"


def _bars(axis: Axes, data: dict[str, Any]) -> None:
    rows, count, libraries = index(data), _shown(data), _libraries(data)
    width = 0.8 / len(libraries)
    for k, library in enumerate(libraries):
        for j, task in enumerate(TASKS):
            row = rows.get((library, task, _layout(library), count, 1))
            if row is None:
                continue
            value = row["per_second"] / 1e6
            ends = [row["count"] / row[key] / 1e6 for key in ("seconds_90", "seconds_10")]
            at = j + (k - (len(libraries) - 1) / 2) * width
            label = LABELS.get(library, library) if j == 0 else None
            axis.bar(at, value, width, color=COLORS[k], label=label,
                     yerr=[[value - ends[0]], [ends[1] - value]], error_kw={"linewidth": 0.8})  # fmt: skip
            axis.annotate(f"{value:.3g}", (at, ends[1]), ha="center", va="bottom", fontsize=6.5)
    axis.set_xticks(range(len(TASKS)), list(TASKS.values()))
    axis.set_yscale("log")
    axis.set_ylabel("million directions / s, one core")
    axis.set_title(f"{count:,} directions, a context each (prepared before)")
    axis.margins(y=0.12)
    axis.legend(frameon=False, ncols=2, loc="upper center", bbox_to_anchor=(0.5, -0.1))


def _curves(axis: Axes, data: dict[str, Any]) -> None:
    for k, library in enumerate(_libraries(data)):
        for task, line in (("eval", "-"), ("fused", "--")):
            rows = sorted(
                (row["count"], row["per_second"] / 1e6)
                for row in data["rows"]
                if (row["library"], row["task"], row["threads"], row["layout"]) == (library, task, 1, _layout(library))
            )
            if rows:
                label = f"{LABELS.get(library, library)}, {task}"
                axis.plot(*zip(*rows, strict=True), line, color=COLORS[k], marker=MARKERS[k], markersize=4, label=label)
    axis.set_xscale("log")
    axis.set_yscale("log")
    axis.set_xlabel("directions per call")
    axis.set_ylabel("million directions / s, one core")
    axis.grid(True)
    axis.legend(frameon=False, fontsize=6.5)


def _ratios(axis: Axes, data: dict[str, Any]) -> None:
    """Of the compiled kernel to Mitsuba, by task, layout and threads, where each is fastest among shared counts."""
    rows, count = index(data), max(_asked(row) for row in data["rows"] if row["library"] == mitsuba(data))
    threads = sorted({row["threads"] for row in data["rows"]})
    kinds = [(t, layout) for t in threads for layout in ("all different", "16 a context")]
    tasks = ["eval", "log_prob", "sample", "fused", "prepare + eval", "prepare + fused"]
    for k, (thread, layout) in enumerate(kinds):
        for j, task in enumerate(tasks):
            row = rows.get(("kernel, compiled", task, layout, count, thread))
            base = _base(data, rows, task, count, thread)
            if row is None or base is None:
                continue
            value = row["per_second"] / base["per_second"]
            label = f"{thread} thread{'s' if thread > 1 else ''}, {layout}" if j == 0 else None
            axis.bar(j + (k - (len(kinds) - 1) / 2) * 0.2, value, 0.2, color=COLORS[k], label=label)
    axis.axhline(1.0, color="black", linewidth=0.8)
    names = [TASKS.get(task, task).replace(" + ", " +\n") for task in tasks]
    axis.set_xticks(range(len(tasks)), names, fontsize=7)
    axis.set_ylabel("compiled kernel / Mitsuba")
    axis.set_title(f"{count:,} directions; above 1 the kernel is faster")
    axis.legend(frameon=False, fontsize=7)


def _roofline(axis: Axes, data: dict[str, Any]) -> None:
    counts = data.get("counts", {})
    tasks = [task for task in ("eval", "log_prob", "sample", "fused", "prepare") if task in counts]
    for j, task in enumerate(tasks):
        bottom = 0.0
        for k, (name, seconds) in enumerate(bounds(data["machine"], counts[task]).items()):
            axis.bar(j - 0.2, 1e9 * seconds, 0.35, bottom=bottom, color=COLORS[k], label=name if j == 0 else None)
            bottom += 1e9 * seconds
        axis.bar(j + 0.2, _measured(data, task), 0.35, color="#444444", label="measured" if j == 0 else None)
    axis.set_xticks(range(len(tasks)), tasks)
    axis.set_ylabel("ns per direction (prepare: context), one core")
    axis.set_title("compiled kernel: what its operations cost at this machine's rates")
    axis.legend(frameon=False, fontsize=7)
