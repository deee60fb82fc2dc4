"""Figure and table of what `scatter_counts.py` measured; nothing is computed here but ratios."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes

from dsfit.experiment.plots.style import COLORS, look, new_figure, save, styled

SHOWN = 32
"""Resolution of the grid whose shares of uncrossed rays are drawn: the nearest one to it."""


def table(data: dict[str, Any]) -> str:
    """Markdown."""
    machine = data["provenance"]["machine"]
    heading = (
        f"{data['rays']} rays for each geometry and kind of points; {machine['processor']}; {data['seconds']:.0f} s. "
        "N: counted fibres; n: the grid's. Bias: mean n against mean N, ± one standard error. Scatter: RMS of N about "
        "its mean at given n, over that of Poisson numbers. Rule: rays for which n <= 1/2 and N = 0 disagree."
    )
    return "\n\n".join([heading, _counts(data), _others(data), _speed(data)]) + "\n"


def _counts(data: dict[str, Any]) -> str:
    lines = [
        "| geometry | points | grid | mean N | bias | n <= 1: n - N | scatter | N = 0 | exp(-n) | 0.3^N | 0.3^n "
        "| 0.7^N | 0.7^n | rule wrong | (v - [N = 0])², Poisson | threshold |",
        "|---|---|" + "---:|" * 14,
    ]
    for row in data["rows"]:
        low, high = row["powers"]["0.3"], row["powers"]["0.7"]
        lines.append(
            f"| {row['geometry']} | {row['points']} | {row['resolution']} | {row['mean_N']:.2f} | {_bias(row)} | "
            f"{row['few'][0]:+.3f} ± {row['few'][1]:.3f} | {row['scatter'] / row['poisson']:.2f} | "
            f"{row['zero']:.3f} | {row['exp']:.3f} | {low[0]:.3f} | {low[1]:.3f} | {high[0]:.3f} | {high[1]:.3f} | "
            f"{row['rule']['wrong']:.1%} | {row['brier']['poisson']:.4f} | {row['brier']['threshold']:.4f} |"
        )
    lines.append("\nThe columns a^n hold exp(-n (1 - a)), which is the mean of a^N for Poisson numbers N of mean n.")
    return "\n".join(lines)


def _bias(row: dict[str, Any], base: dict[str, Any] | None = None) -> str:
    mean = (base or row)["mean_N"]
    return f"{row['mean_n'] / mean - 1:+.1%} ± {row['error'] / mean:.1%}"


def _others(data: dict[str, Any]) -> str:
    """Other treatments: bias, thin rays, exp(-n) against N = 0; and errors of the step."""
    names = list(data["rows"][0]["others"])
    lines = [
        "Bias, mean exp(-n) less the share of N = 0, and mean of (exp(-n) - [N = 0])², for the default (a quarter of a "
        "voxel on, the own fibre taken off, the sine with the term for its spread), and with other starts, which keep "
        "the own fibre, and the root of the mean square sine alone:\n",
        "| geometry | points | grid | default | " + " | ".join(names) + " |",
        "|---|---|---:|---|" + "---|" * len(names),
    ]
    for row in data["rows"]:
        cells = [_short(row)] + [_short(row["others"][name]) for name in names]
        lines.append(f"| {row['geometry']} | {row['points']} | {row['resolution']} | " + " | ".join(cells) + " |")
    steps = list(data["rows"][0]["steps"])
    lines += [
        "\nRMS error of n by the march's step, in voxels, against the finest:\n",
        "| geometry | points | grid | mean n | scatter of N | " + " | ".join(f"step {step}" for step in steps) + " |",
        "|---|---|---:|---:|---:|" + "---:|" * len(steps),
    ]
    for row in data["rows"]:
        cells = [f"{row['steps'][step]:.3f}" for step in steps]
        lines.append(
            f"| {row['geometry']} | {row['points']} | {row['resolution']} | {row['mean_n']:.2f} | "
            f"{row['scatter']:.2f} | " + " | ".join(cells) + " |"
        )
    return "\n".join(lines)


def _short(row: dict[str, Any]) -> str:
    return f"{row['mean_n'] / row['mean_N'] - 1:+.1%}, {row['exp'] - row['zero']:+.3f}, {row['brier']['poisson']:.4f}"


def _speed(data: dict[str, Any]) -> str:
    names = list(data["speed"][0]["nanoseconds"])
    lines = [
        "Nanoseconds a ray on one core, float32, from points on fibres; memory with both forms of the moments; seconds "
        "to fill the grid:\n",
        "| geometry | grid | backend | " + " | ".join(names) + " | memory / MB | seconds |",
        "|---|---:|---|" + "---:|" * (len(names) + 2),
    ]
    for row in data["speed"]:
        cells = [f"{row['nanoseconds'][name]:.0f}" for name in names]
        shape = " x ".join(str(count) for count in row["voxels"])
        cells += [f"{row['memory'] / 1e6:.2f}", f"{row['seconds']:.2f}"]
        lines.append(f"| {row['geometry']} | {shape} | {row['backend']} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def figure(data: dict[str, Any], folder: Path) -> None:
    """scatter_counts.png and .pdf: bias, scatter, shares of uncrossed rays, and the two rules for v."""
    with styled():
        page = new_figure(9.0, 6.4)
        axes = page.subplots(2, 2)
        _by_resolution(axes[0, 0], data, lambda row: row["mean_n"] / row["mean_N"] - 1)
        axes[0, 0].set_ylabel("bias of n, relative")
        axes[0, 0].axhline(0, color="black", linewidth=0.8)
        _by_resolution(axes[0, 1], data, lambda row: row["scatter"] / row["poisson"])
        axes[0, 1].set_ylabel("scatter of N at given n / Poisson")
        axes[0, 1].axhline(1, color="black", linewidth=0.8)
        _uncrossed(axes[1, 0], data)
        _rules(axes[1, 1], data)
        axes[0, 0].legend(frameon=False, fontsize=7)
        save(page, folder, "scatter_counts")


def _series(data: dict[str, Any]) -> dict[tuple[str, str], list[dict[str, Any]]]:
    found: dict[tuple[str, str], list[dict[str, Any]]] = {}
    for row in data["rows"]:
        found.setdefault((row["geometry"], row["points"]), []).append(row)
    return found


def _style(geometry: str, where: str, data: dict[str, Any]) -> dict[str, Any]:
    names = list(dict.fromkeys(row["geometry"] for row in data["rows"]))
    return look(names.index(geometry)) | {
        "linestyle": "-" if where == "fibres" else ":",
        "markerfacecolor": None if where == "fibres" else "white",
        "label": f"{geometry}, points {'on fibres' if where == 'fibres' else 'seen'}",
        "linewidth": 1.2,
        "markersize": 4,
    }


def _by_resolution(axes: Axes, data: dict[str, Any], value: Any) -> None:
    for key, rows in _series(data).items():
        axes.plot([row["resolution"] for row in rows], [value(row) for row in rows], **_style(*key, data))
    axes.set_xscale("log", base=2)
    ticks = sorted({row["resolution"] for row in data["rows"]})
    axes.set_xticks(ticks, [str(tick) for tick in ticks], minor=False)
    axes.minorticks_off()
    axes.set_xlabel("voxels along the longest side")
    axes.grid(True)


def _uncrossed(axes: Axes, data: dict[str, Any]) -> None:
    """Share of rays with N = 0 against n, and exp(-n)."""
    x = np.linspace(0, 5, 100)
    axes.plot(x, np.exp(-x), color="black", linewidth=0.8, label="exp(-n)")
    axes.step([0, 0.5, 0.5, 5], [1, 1, 0, 0], color=COLORS[7], linewidth=0.8, label="threshold")
    for key, rows in _series(data).items():
        row = min(rows, key=lambda row: abs(row["resolution"] - SHOWN))
        bins = [entry for entry in row["bins"] if entry is not None and entry["n"] < 5]
        style = _style(*key, data) | {"linestyle": "none", "label": None}
        share = np.array([entry["zero"] for entry in bins])
        error = np.sqrt(np.maximum(share * (1 - share), 1e-4) / [entry["rays"] for entry in bins])
        axes.errorbar([entry["n"] for entry in bins], share, yerr=error, elinewidth=0.6, **style)
    axes.set_xlabel(f"n of a grid of {row['resolution']}")
    axes.set_ylabel("share of rays with N = 0")
    axes.legend(frameon=False)
    axes.grid(True)


def _rules(axes: Axes, data: dict[str, Any]) -> None:
    """Mean square error of v, by rule: solid Poisson, dashed threshold; points on fibres."""
    for (geometry, where), rows in _series(data).items():
        if where != "fibres":
            continue
        style = _style(geometry, where, data)
        for rule, line in (("poisson", "-"), ("threshold", "--")):
            values = [row["brier"][rule] for row in rows]
            name = "v = exp(-n)" if rule == "poisson" else "v = 1 for n <= 1/2"
            label = name if style["color"] == COLORS[0] else None  # once
            axes.plot([row["resolution"] for row in rows], values, **style | {"linestyle": line, "label": label})
    axes.set_xscale("log", base=2)
    ticks = sorted({row["resolution"] for row in data["rows"]})
    axes.set_xticks(ticks, [str(tick) for tick in ticks])
    axes.minorticks_off()
    axes.set_ylim(bottom=0)
    axes.set_xlabel("voxels along the longest side")
    axes.set_ylabel("mean of (v - [N = 0])², points on fibres")
    axes.legend(frameon=False)
    axes.grid(True)
