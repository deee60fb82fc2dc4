"""Table of excess and of time to 1 % error per context, from a run of configs/bench_36.toml.

    dsfit run configs/bench_36.toml
    python experiments/table_36.py runs/bench_36-ID [TABLE.md]

Reads the run's result.json and computes nothing but ratios. TABLE.md is table_contexts.md in the run directory, if left
out.
"""

from __future__ import annotations

import json
import statistics
import sys
from pathlib import Path

COLUMNS = ("uniform sphere", "all, balance", "all, optimal", "best heuristic mix", "structured, not fitted", "fitted")


def table(result: dict) -> str:
    """Markdown: a row per context, then what the bars are about."""
    lines = ["| context | quantity | " + " | ".join(COLUMNS) + " | best single heuristic | largest weight, fitted |"]
    lines.append("|---|---|" + "---:|" * (len(COLUMNS) + 2))
    ratios, fitted, speed = [], [], []
    for cell in result["cells"]:
        by_name = {method["name"]: method for method in cell["methods"]}
        single = [m for name, m in by_name.items() if name.endswith(" only")]
        for key, label in (("excess", "excess"), ("seconds_to_1_percent", "s to 1 %")):
            values = [_number(by_name[name][key]) for name in COLUMNS]
            best = min(_number(m[key]) for m in single)
            weight = f"{by_name['fitted']['largest_weight']:.3g}" if key == "excess" else ""
            cells = " | ".join(f"{value:.3g}" for value in [*values, best])
            lines.append(f"| {cell['label']} | {label} | {cells} | {weight} |")
        excess = {name: _number(by_name[name]["excess"]) for name in COLUMNS}
        seconds = {name: _number(by_name[name]["seconds_to_1_percent"]) for name in COLUMNS}
        fitted.append(excess["fitted"])
        ratios.append(excess["best heuristic mix"] / excess["fitted"])
        speed.append(seconds["best heuristic mix"] / seconds["fitted"])
    lines += [
        "",
        f"fitted: excess median {statistics.median(fitted):.2g}, worst {max(fitted):.2g}; "
        f"below the best heuristic mix by {min(ratios):.3g} (least), {statistics.median(ratios):.3g} (median), "
        f"{max(ratios):.3g} (most), under 100 in {sum(r < 100 for r in ratios)} of {len(ratios)} contexts; "
        f"time to 1 % below the best mix by {min(speed):.3g}, {statistics.median(speed):.3g}, {max(speed):.3g}.",
        "",
    ]
    return "\n".join(lines)


def _number(value: float | str | None) -> float:
    return float("inf") if value is None else float(value)


def main(arguments: list[str]) -> None:
    """Command line; see the module text."""
    folder = Path(arguments[0])
    target = Path(arguments[1]) if len(arguments) > 1 else folder / "table_contexts.md"
    text = table(json.loads((folder / "result.json").read_text()))
    target.write_text(text)
    print(text)


if __name__ == "__main__":
    main(sys.argv[1:])
