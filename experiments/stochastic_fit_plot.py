"""Figure and table of `stochastic_fit.py`, from the file that it wrote.

    python experiments/stochastic_fit_plot.py [FOLDER]    # runs/stochastic_fit if left out
"""

from __future__ import annotations

import json
import statistics
import sys
from pathlib import Path
from typing import Any

from matplotlib.ticker import NullFormatter

from dsfit.experiment.plots.style import COLORS, new_figure, save, styled


def table(data: dict[str, Any]) -> str:
    """The results in Markdown: medians over seeds, with the range."""
    lines = [
        "| scene | noise | start | quadrature | evaluations | method | excess | range | evaluations | seconds ratio |",
        "|---|---|---:|---:|---:|---|---:|---|---:|---:|",
    ]
    for row in data["single"]:
        known = row["quadrature"]
        where = f"{row['preset']} {row['theta']:g}° n = {row['n']:g}, {row['light']}"
        for name, runs in row["methods"].items():
            found = sorted(run["excess"] for run in runs)
            evaluations = statistics.median(run["evaluations"] for run in runs)
            ratio = statistics.median(run["seconds"] for run in runs) / known["seconds"]
            lines.append(
                f"| {where} | {row['noise'] or 'none'} | {row['start']:.2g} | {known['excess']:.2g} | "
                f"{known['evaluations']} | {name} | {statistics.median(found):.2g} | "
                f"{found[0]:.2g} to {found[-1]:.2g} | {evaluations:.0f} | {ratio:.2g} |"
            )
    return "\n".join(lines)


def plot(folder: Path) -> list[Path]:
    """The figure from `stochastic_fit.json`."""
    data = json.loads((folder / "stochastic_fit.json").read_text())
    rows = data["single"]
    clean = [row for row in rows if row["noise"] is None]
    noisy = [row for row in rows if row["noise"] is not None]
    with styled():
        figure = new_figure(11.0, 7.4)
        grid = figure.subplots(2, 3)
        for axes, column, label in ((grid[0, 0], 0, "evaluations of the integrand"), (grid[0, 1], 1, "seconds")):
            for k, row in enumerate(clean):
                _curves(axes, row["methods"]["gauss_newton"], column, COLORS[k % len(COLORS)], row["quadrature"])
            axes.set(xscale="log", yscale="log", xlabel=label, ylabel="excess / excess of the quadrature fit")
            axes.axhline(1.0, color="black", linewidth=0.8)
            axes.set_title("a colour a scene; squares: quadrature fit")
        for k, row in enumerate(noisy):
            for name, style in (("gauss_newton", "-"), ("gauss_newton, two draws", "--")):
                _curves(grid[0, 2], row["methods"][name], 0, COLORS[k], None, style,
                        f"{row['preset']}, {row['noise']}, {'two draws' if 'two' in name else 'one draw'}")  # fmt: skip
            grid[0, 2].axhline(row["quadrature"]["excess"], color=COLORS[k], linewidth=0.6, linestyle=":")
        grid[0, 2].set(xscale="log", yscale="log", xlabel="evaluations of the integrand", ylabel="excess")
        grid[0, 2].set_title("noisy light; dotted: without noise")
        grid[0, 2].legend(fontsize=6)
        _bars(grid[1, 0], rows)
        for axes, name, panel in ((grid[1, 1], "stream", _stream), (grid[1, 2], "gradients", _factors)):
            if name in data:
                panel(axes, data[name])
            else:
                axes.set_visible(False)
        for axes in grid.flat:
            axes.grid(True)
            if axes.get_yscale() == "log":
                axes.yaxis.set_minor_formatter(NullFormatter())
        return save(figure, folder, "stochastic_fit")


def _curves(
    axes: Any, runs: list[dict], column: int, color: str, known: Any, style: str = "-", label: str = ""
) -> None:
    """The median of the seeds at each step, and their range."""
    scale = 1.0 if known is None else known["excess"]
    length = min(len(run["curve"]) for run in runs)
    x = [statistics.median(run["curve"][i][column] for run in runs) for i in range(1, length)]
    y = [sorted(run["curve"][i][2] / scale for run in runs) for i in range(1, length)]
    axes.plot(x, [statistics.median(values) for values in y], style, color=color, linewidth=1.2, label=label)
    axes.fill_between(x, [v[0] for v in y], [v[-1] for v in y], color=color, alpha=0.12, linewidth=0)
    if known is not None:
        at = known["evaluations"] if column == 0 else known["seconds"]
        axes.plot([at], [1.0], "s", color=color, markersize=4)


def _bars(axes: Any, rows: list[dict[str, Any]]) -> None:
    """Where every method ended."""
    names = ["quadrature", "gauss_newton", "gauss_newton, two draws", "adam"]
    named = set()
    for k, name in enumerate(names):
        for i, row in enumerate(rows):
            runs = [row["quadrature"]] if name == "quadrature" else row["methods"].get(name, [])
            if runs:
                found = sorted(run["excess"] for run in runs)
                x = i + 0.18 * (k - 1.5)
                axes.plot([x, x], [found[0], found[-1]], color=COLORS[k], linewidth=1.5)
                axes.plot([x], [statistics.median(found)], "o", color=COLORS[k], markersize=3.5,
                          label=None if name in named else name)  # fmt: skip
                named.add(name)
    for i, row in enumerate(rows):
        label = None if i else "start"
        axes.plot([i - 0.4, i + 0.4], [row["start"]] * 2, color="#8c8c8c", linewidth=1.0, label=label)
    labels = [f"{row['preset']} {row['theta']:g}° {row['n']:g}" + (" lobe" if row["light"] != "furnace" else "")
              + (f" {row['noise']}" if row["noise"] else "") for row in rows]  # fmt: skip
    axes.set_xticks(range(len(rows)), labels, rotation=90, fontsize=5.5)
    axes.set(yscale="log", ylabel="excess")
    axes.set_title("where fits ended: median, range")
    axes.legend(fontsize=6)


def _stream(axes: Any, data: dict[str, Any]) -> None:
    """Excess of the amortised proposal over evaluations."""
    x = [max(evaluations, 1000) for evaluations, _, _ in data["curve"]]
    for name, pick, color in (("worst", max, COLORS[1]), ("median", statistics.median, COLORS[0])):
        axes.plot(x, [pick(values) for _, _, values in data["curve"]], "o-", color=color, label=name, markersize=3.5)
    axes.set(xscale="log", yscale="log", xlabel="evaluations of the integrand", ylabel="excess")
    axes.set_title(f"amortised, {data['contexts']} other contexts")
    axes.legend()


def _factors(axes: Any, factors: dict[str, list[float]]) -> None:
    """Variance of the gradient against the plain estimator."""
    for i, (factor, low, high) in enumerate(factors.values()):
        axes.plot([i, i], [low, high], color=COLORS[0])
        axes.plot([i], [factor], "o", color=COLORS[0])
    axes.set_xticks(range(len(factors)), list(factors), rotation=30, ha="right")
    axes.set(yscale="log", ylabel="variance of plain / variance")
    axes.set_title("gradient: 95 % intervals")


if __name__ == "__main__":
    where = Path(sys.argv[1] if len(sys.argv) > 1 else "runs/stochastic_fit")
    print(table(json.loads((where / "stochastic_fit.json").read_text())))
    for path in plot(where):
        print(path, file=sys.stderr)
