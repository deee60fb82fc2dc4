"""Tables of throughput: million directions per second with ratios to Mitsuba, costs of terms, limits."""

from __future__ import annotations

from typing import Any

from dsfit.figures import Table
from experiments._throughput_bounds import bounds
from experiments._throughput_rows import LABELS, TASKS, Rows, base, index, measured, mitsuba, rate

_MORE_TASKS = ("prepare + eval", "prepare + fused", "to_angles")


def _heading(record: dict[str, Any]) -> str:
    load, theirs = record["load"], record["mitsuba"]
    peer = f"Mitsuba {theirs['version']}, {theirs['variant']} ({theirs['reason']})"
    return (
        f"{load['cores']} cores; load {load['before']:.1f} before, {load['after']:.1f} after (1 is one busy core). "
        f"{peer if theirs['variant'] else theirs['reason']}. Kernels: "
        + "; ".join(f"{name}: {backend}" for name, backend in record.get("backends", {}).items())
    )


def rates(record: dict[str, Any]) -> Table:
    """A row for each task, library and layout, a column for each number of directions and threads."""
    rows = index(record)
    columns = sorted({(key[4], key[3]) for key, row in rows.items() if row["task"] != "prepare"})
    titles = [f"{count:.0e}".replace("e+0", "e") + (f", {threads} threads" if threads > 1 else "")
              for threads, count in columns]  # fmt: skip
    order = {task: k for k, task in enumerate([*TASKS, *_MORE_TASKS])}
    seen = dict.fromkeys((row["task"], row["library"], row["layout"]) for row in record["rows"])
    lines = []
    for task, library, layout in sorted(seen, key=lambda key: (order.get(key[0], 99), key[1] != mitsuba(record))):
        if task in order:
            cells = [_cell(record, rows, library, task, layout, *column) for column in columns]
            lines.append([TASKS.get(task, task), LABELS.get(library, library), layout, *cells])
    caption = (
        "Million directions per second, of processor time for one thread, of wall time for two: median (10 to 90 %), "
        f"and the ratio to Mitsuba for the same directions and threads. {_heading(record)}."
    )
    return Table("rates", caption, ["task", "library", "contexts", *titles], lines, "lll" + "r" * len(columns))


def _cell(record: dict, rows: Rows, library: str, task: str, layout: str, threads: int, count: int) -> str:
    row = rows.get((library, task, layout, count, threads))
    if row is None:
        return ""
    text = f"{rate(row):.3g} ({rate(row, 'high'):.3g}-{rate(row, 'low'):.3g})"
    other = base(record, rows, task, count, threads)
    return text if other is None or other is row else f"{text} x{rate(row) / rate(other):.2f}"


def terms(record: dict[str, Any]) -> Table:
    """Nanoseconds per direction of the compiled kernel's tasks and terms, one thread, for the most directions."""
    rows = [row for row in record["rows"] if row["threads"] == 1 and row["library"] == "kernel, compiled"]
    largest = max((row["count"] for row in rows if row["task"] == "eval"), default=0)
    lines = [
        [row["task"], row["layout"], f"{1e3 / rate(row):.1f}"]
        for row in rows
        if row["count"] == largest or (row["task"] == "prepare" and row["count"] >= largest / 16)
    ]
    caption = "Compiled kernel, one thread: nanoseconds per direction, of `prepare` per context."
    return Table("terms", caption, ["task", "contexts", "ns"], lines, "llr")


def limits(record: dict[str, Any]) -> Table:
    """What a task needs of each resource, and how long that takes at the machine's rates."""
    counts = record.get("counts", {})
    names = list(bounds(record["machine"], {})) if counts else []
    lines = []
    for task in [task for task in ("prepare", *TASKS) if task in counts]:
        count = counts[task]
        found = bounds(record["machine"], count)
        count = {**count, "look-ups": count.get("lines") or count.get("gathers", 0)}
        cells = [f"{count.get(name, 0):.3g}, {1e9 * found[name]:.2g}" for name in names]
        lines.append([task, *cells, f"{1e9 * sum(found.values()):.3g}", f"{measured(record, task):.3g}"])
    caption = (
        "Compiled kernel, one thread: operations per direction (per context for `prepare`) and the nanoseconds that "
        "they take at the rates of this machine; their sum, as if nothing ran at the same time; and what was measured."
    )
    return Table("limits", caption, ["task", *names, "sum, ns", "measured, ns"], lines)
