"""Draws bounds beside true errors, and what is saved; tabulates both."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from dsfit.experiment.plots.style import COLORS
from dsfit.figures import Data, Table
from dsfit.figures.page import Page

SHOWN = {
    "evaluation": "evaluation",
    "every_term": "evaluation, against every term",
    "kernel": "kernel, against every term",
    "quadrature": "quadrature nodes",
    "fit": "fit, nodes included",
}
FLOOR = 1e-7
"""Errors below what the quadratures can tell are drawn there."""


def figures(data: Data, page: Page) -> dict[str, Figure]:
    """Errors on the left, ratios of times on the right, a row for each scene."""
    scenes = data.record["scenes"]
    figure = page.figure(0.85)
    left, right = figure.subplots(1, 2, sharey=True, width_ratios=(1, 1.25))
    _errors(left, scenes, float(data.record["tolerance"]))
    _times(right, scenes)
    left.set_ylim(len(scenes) - 0.5, -0.5)
    for axis in (left, right):
        axis.set_yticks(range(len(scenes)), [row["name"].replace(" ", "\n", 1) for row in scenes])
        axis.grid(True, axis="x")
    figure.legend(loc="outside lower center", ncols=2, frameon=False)
    return {"planning": figure}


def captions(data: Data) -> dict[str, str]:
    """What the figure shows."""
    scenes = data.record["scenes"]
    exact = sum(row["plan"]["bound"] == 0 for row in scenes)
    times = " to ".join(f"{pick(row['quadrature']['ratio'] for row in scenes):.2f}" for pick in (min, max))
    fits = " to ".join(f"{pick(row['fit']['ratio'] for row in scenes):.2f}" for pick in (min, max))
    return {
        "planning": f"What planning leaves out of {len(scenes)} scenes at a tolerance of "
        f"{float(data.record['tolerance']):g} (dotted). Left: true relative error of the integral, by quadrature, the "
        "worst over a scene's contexts, and the bound that is proven before anything is computed; exact: what goes is "
        f"zero ({exact} scenes). Right: time before over time after, medians of calls in turn, with 95 % "
        "intervals (of fits: the range); “against every term”: compared with computing every term, zero or not. "
        f"Quadrature nodes become {times} times as fast, fits {fits} times."
    }


def _errors(axis: Axes, scenes: list[dict[str, Any]], tolerance: float) -> None:
    for k, row in enumerate(scenes):
        bound = row["plan"]["bound"]
        if bound > 0:
            error = max(row["error"], FLOOR)
            axis.plot([error, bound], [k, k], color="0.75", zorder=1)
            axis.plot(bound, k, "|", color=COLORS[1], ms=14, mew=2)
            axis.plot(error, k, "o", color=COLORS[0])
        else:
            axis.text(np.sqrt(3e-2 * FLOOR), k, "exact", va="center", ha="center", color="0.4")
    axis.plot([], [], "|", color=COLORS[1], ms=12, mew=2, linestyle="none", label="proven bound")
    axis.plot([], [], "o", color=COLORS[0], linestyle="none", label="true error, by quadrature")
    axis.axvline(tolerance, color="0.4", ls=":", lw=1, label="tolerance")
    axis.set(xscale="log", xlim=(FLOOR / 2, 3e-2), xlabel="error of the integral, relative")


def _times(axis: Axes, scenes: list[dict[str, Any]]) -> None:
    y = np.arange(len(scenes))
    for k, (key, label) in enumerate(SHOWN.items()):
        ratio = np.array([row[key]["ratio"] for row in scenes])
        ends = np.array([row[key]["interval"] for row in scenes])
        height = y + (k - 2) * 0.17
        axis.barh(height, ratio - 1, 0.15, left=1.0, color=COLORS[k], label=label)
        axis.hlines(height, ends[:, 0], ends[:, 1], color="black", lw=0.8)
    axis.axvline(1.0, color="0.4", lw=1)
    axis.set(xlabel="time before / after: median and interval", xscale="log")
    ticks = [0.5, 1, 2, 4, 8]
    axis.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
    axis.minorticks_off()
    least = min(row[key]["interval"][0] for row in scenes for key in SHOWN)
    most = max(row[key]["interval"][1] for row in scenes for key in SHOWN)
    axis.set_xlim(min(0.7, 0.9 * least), max(4.5, 1.1 * most))


def tables(data: Data) -> list[Table]:
    """What goes and by how much that is wrong; what is saved."""
    scenes = data.record["scenes"]
    left_out, saved, seconds = [], [], []
    for row in scenes:
        bound = "exact" if row["plan"]["bound"] == 0 else f"{row['plan']['bound']:.1e}"
        error = "0" if row["error"] <= max(row["error_accuracy"], 1e-14) else f"{row['error']:.1e}"
        excess = [f"{value:.1e}" for value in row["excess"]]
        left_out.append([row["name"], gone(row["plan"]), bound, error, *excess])
        (a, b), (c, d) = row["nodes"], row["components"]
        texts = [ratio_text(row[key]) for key in SHOWN]
        saved.append([row["name"], *texts[:4], f"{a} → {b}", texts[4], f"{c} → {d}"])
        times = [" → ".join(f"{1e3 * value:.3g}" for value in row[key]["seconds"]) for key in SHOWN]
        seconds.append([row["name"], f"{1e3 * row['plan_seconds']:.0f}", *times])
    return [
        Table(
            "left_out",
            f"What goes at a tolerance of {float(data.record['tolerance']):g} (in brackets what goes by a bound, the "
            "rest is exactly zero), the bound and the true error of the integral, by quadrature, the worst over the "
            "scene's contexts; and the excess of a fit to all and to what is left, against the whole integrand.",
            ["scene", "goes", "bound", "true error", "excess, fit to all", "fit to what is left"],
            left_out,
            "llrrrr",
        ),
        Table(
            "saved",
            "Time before over time after: medians of calls in turn, with 95 % intervals by order statistics (of fewer "
            "than six calls, as for fits, their range); quadrature nodes and lobes of the fitted proposal before and "
            "after.",
            ["scene", *list(SHOWN.values())[:4], "nodes", SHOWN["fit"], "lobes"],
            saved,
        ),
        Table(
            "seconds",
            "Milliseconds of planning, and of a call before and after.",
            ["scene", "plan", *SHOWN.values()],
            seconds,
        ),
    ]


def ratio_text(row: dict[str, Any]) -> str:
    """The ratio with its interval."""
    low, high = row["interval"]
    return f"{row['ratio']:.2f} ({low:.2f} to {high:.2f})"


def gone(plan: dict[str, Any]) -> str:
    """What goes, in a few words; what goes by a bound in brackets."""
    parts = []
    for half in ("direct", "scattered"):
        terms = [d for d in plan["dropped"] if d["half"] == half and d["term"] != "glint"]
        if len(terms) == 4 and all(d["bound"] == 0 for d in terms):
            parts.append(f"all {half}")
        elif terms:
            names = ", ".join(f"({d['term']})" if d["bound"] > 0 else d["term"] for d in terms)
            parts.append(f"{half} {names}")
    if any(d["term"] == "glint" and d["bound"] > 0 for d in plan["dropped"]):
        parts.append("(treatment of the caustic)")
    if plan["grey"]:
        parts.append("all channels but one")
    return "; ".join(parts) or "nothing"
