"""Draws the pictures with their error maps, and errors and weights that explain them."""

from __future__ import annotations

import io
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from dsfit.experiment.files import number
from dsfit.experiment.plots.style import COLORS, MARKERS
from dsfit.figures import Data, Table
from dsfit.figures.page import Page

LOW, HIGH = 0.01, 2.0
"""Relative errors at the ends of the stored maps."""
_SHOWN = 4
_LIGHTS = {"lamp": "a lamp of 5° and a sky", "sky": "a sky, the same from everywhere"}


def figures(data: Data, page: Page) -> dict[str, Figure]:
    """For each light the pictures; errors and weights of both."""
    made = {f"pictures-{scene}": _pictures(data, page, scene) for scene in sorted(data.record["scenes"])}
    return {**made, "weights": _weights(data, page)}


def captions(data: Data) -> dict[str, str]:
    """What the figures show."""
    record, found = data.record, {}
    for scene in sorted(record["scenes"]):
        names, facts = _techniques(data, scene), record["scenes"][scene]
        reference, seconds = facts["reference"], number(record["equal_seconds"])
        told = ", ".join(f"{name} {_percent(facts['of'][name]['equal_time']['error'])}" for name in names)
        found[f"pictures-{scene}"] = (
            f"Block of {reference['strands']:,} blond strands under {_LIGHTS[scene]}, {reference['width']} × "
            f"{reference['height']} pixels. Above: pictures after about {seconds:g} s of one core, as many directions "
            "per hit as a trial gave to expect in that time, and their relative errors on a logarithmic scale; below: "
            f"the middle with {record['equal_samples']} directions for every hit. Under the maps: root mean square of "
            "the relative error and FLIP, both against the reference "
            f"({reference['samples']:,} directions per hit, ±{_percent(reference['own_error'])}). Errors "
            f"after equal time: {told}."
        )
    found["weights"] = (
        "Why the pictures differ, a row for each light. Left: relative error of the picture against directions per "
        "hit, measured (marks), and predicted from ∫F²/p at hits of some pixels (dashed). Middle: chance that the "
        "weight of a sample, over its mean, is above w; right: part of the second moment that such weights carry. "
        "Where it sits in weights too rare to be drawn, measured errors stay below what is predicted, until one comes."
    )
    return found


def _image(data: Data, name: str) -> np.ndarray:
    from PIL import Image

    return np.asarray(Image.open(io.BytesIO(data.arrays[name].tobytes())))


def _techniques(data: Data, scene: str) -> list[str]:
    """The techniques that are shown: those with random points."""
    found = data.record["scenes"][scene]
    return [name for name in found["techniques"] if found["of"][name]["uniforms"] == "random"][:_SHOWN]


def _pictures(data: Data, page: Page, scene: str) -> Figure:
    """Rows: pictures at equal time, maps of their errors; the middle of those at equal samples, maps. The reference is
    last."""
    names, found = _techniques(data, scene), data.record["scenes"][scene]
    figure = page.figure(1.02)
    axes = figure.subplots(4, len(names) + 1)
    for axis in axes.flat:
        axis.set(xticks=[], yticks=[])
        axis.spines[:].set_visible(False)
    seconds, samples = number(data.record["equal_seconds"]), data.record["equal_samples"]
    heads = {"equal_time": f"about {seconds:g} s", "equal_samples": f"{samples} per hit"}
    for column, name in enumerate(names):
        axes[0, column].set_title(_broken(name), fontsize=8)
        for row, which in enumerate(heads):
            facts = found["of"][name][which]
            _show(axes[2 * row, column], _image(data, f"{scene}.{name}.{which}"))
            _error_map(axes[2 * row + 1, column], _image(data, f"{scene}.{name}.{which}.map"))
            took = f"{facts['samples']:,} per hit, {number(facts['seconds']):.1f} s"
            axes[2 * row, column].set_xlabel(took, fontsize=7, labelpad=2)
            text = f"{_percent(facts['error'])}, FLIP {number(facts['flip']):.3f}"
            axes[2 * row + 1, column].set_xlabel(text, fontsize=7, labelpad=2)
    for row, text in enumerate(heads.values()):
        axes[2 * row, 0].set_ylabel(text, fontsize=8)
        axes[2 * row + 1, 0].set_ylabel("relative error", fontsize=8)
    _reference(data, scene, axes)
    bar = figure.colorbar(
        ScalarMappable(LogNorm(LOW, HIGH), "magma"), ax=axes.ravel().tolist(), location="bottom", aspect=45, shrink=0.6,
        pad=0.02, extend="both",
    )  # fmt: skip
    bar.set_ticks([0.01, 0.1, 1], labels=["1 %", "10 %", "100 %"])
    bar.ax.tick_params(labelsize=7)
    figure.suptitle(f"Blond hair under {_LIGHTS[scene]}", fontsize=9)
    return figure


def _reference(data: Data, scene: str, axes: Any) -> None:
    """Whole, and the window that the pictures at equal samples show."""
    facts, image = data.record["scenes"][scene]["reference"], _image(data, f"{scene}.reference")
    _show(axes[0, -1], image)
    axes[0, -1].set_title("reference", fontsize=8)
    own = f"{facts['samples']:,} per hit, ±{_percent(facts['own_error'])}"
    axes[0, -1].set_xlabel(own, fontsize=7, labelpad=2)
    part = number(data.record["crop"])
    rows, columns = (max(1, round(part * size)) for size in image.shape[:2])
    top, left = (image.shape[0] - rows) // 2, (image.shape[1] - columns) // 2
    _show(axes[2, -1], image[top : top + rows, left : left + columns])
    for row in (1, 3):
        axes[row, -1].set_visible(False)


def _broken(name: str) -> str:
    """A long name on two lines."""
    words = name.split(" ")
    half = (len(words) + 1) // 2
    return name if len(name) < 13 else " ".join(words[:half]) + "\n" + " ".join(words[half:])


def _show(axis: Axes, image: np.ndarray) -> None:
    axis.imshow(image, cmap="gray", vmin=0, vmax=255, interpolation="nearest")


def _error_map(axis: Axes, shade: np.ndarray) -> None:
    axis.imshow(shade, cmap="magma", vmin=0, vmax=255, interpolation="nearest")


def _percent(value: Any) -> str:
    return f"{100 * number(value):.3g} %"


def _weights(data: Data, page: Page) -> Figure:
    """Left: error over samples per hit, measured, and predicted from the weights (lines). Right: how often a weight is
    above w, and how much of the second moment such weights carry."""
    scenes = sorted(data.record["scenes"])
    figure = page.figure(0.42 * len(scenes) + 0.12)
    axes = figure.subplots(len(scenes), 3, squeeze=False)
    labels: dict[str, int] = {}
    for row, scene in enumerate(scenes):
        for name in _techniques(data, scene):
            plain = name.replace(" + light", "") if name.startswith("fitted") else name
            k = labels.setdefault(plain, len(labels))
            _errors(axes[row, 0], data.record["scenes"][scene]["of"][name], k)
            if f"{scene}.{name}.survival" in data.arrays:
                weights = data.arrays["weights"]
                for axis, key in zip(axes[row, 1:], ("survival", "moment"), strict=True):
                    axis.plot(weights, data.arrays[f"{scene}.{name}.{key}"], color=COLORS[k], linewidth=1.2)
        axes[row, 0].set(xscale="log", yscale="log", xlabel="directions per hit", ylabel=f"{scene}\nrelative error")
        axes[row, 0].set_yticks([0.01, 0.1, 1, 10], labels=["1 %", "10 %", "100 %", "1000 %"])
        axes[row, 1].set(xscale="log", yscale="log", xlabel="w", ylim=(1e-10, 2))
        axes[row, 2].set(xscale="log", xlabel="w", ylim=(0, 1.03))
        for axis in axes[row]:
            axis.grid(True)
    for axis, title in zip(axes[0], ("error", "chance of a weight above w", "part of ∫F²/p above w"), strict=True):
        axis.set_title(title, fontsize=8)
    handles = [
        Line2D([], [], color=COLORS[k], marker=MARKERS[k], markersize=4, linewidth=1.2, label=name)
        for name, k in labels.items()
    ]
    handles.append(Line2D([], [], color="black", linestyle="--", linewidth=1, label="predicted"))
    figure.legend(handles=handles, loc="outside lower center", ncols=3, frameon=False)
    return figure


def _errors(axis: Axes, facts: dict[str, Any], k: int) -> None:
    samples, errors = (np.array([number(x) for x in facts["rungs"][key]]) for key in ("samples", "error"))
    axis.plot(samples, errors, MARKERS[k], color=COLORS[k], markersize=3.5)
    known = facts["equal_time"]
    if "predicted" in known:
        law = number(known["predicted"]) * np.sqrt(number(known["samples"]) / samples)
        axis.plot(samples, law, "--", color=COLORS[k], linewidth=1.0)


def tables(data: Data) -> list[Table]:
    """Numbers of the pictures, for either light and either equality."""
    return [_table(data, scene) for scene in sorted(data.record["scenes"])]


def _table(data: Data, scene: str) -> Table:
    found = data.record["scenes"][scene]
    reference = found["reference"]
    rows = []
    for which, label in (("equal_time", "equal time"), ("equal_samples", "equal samples")):
        for k, name in enumerate(found["techniques"]):
            of = found["of"][name]
            facts = of[which]
            predicted = _predicted(facts) if of["uniforms"] == "random" else "-"
            rows.append([
                label if k == 0 else "", name, f"{number(facts['seconds']):.2f}", f"{facts['samples']:,}",
                _percent(facts["error"]), predicted, f"{number(facts['rmse']):.3g}", f"{number(facts['flip']):.3f}",
                f"{100 * number(facts['worst_share']):.0f} %",
            ])  # fmt: skip
    check = reference["check"]
    caption = (
        f"Block of {reference['strands']:,} blond strands under {_LIGHTS[scene]}; {reference['width']} x "
        f"{reference['height']} pixels, {reference['hits']:,} hits; seconds of one core for sampling and shading, "
        "without preparation. Error: root of the relative mean square over covered pixels, without the reference's own "
        f"{_percent(reference['own_error'])} ({reference['samples']:,} directions per hit; a second technique "
        f"{'agrees' if check['verdict'] == 'agree' else 'DIFFERS'}, {100 * number(check['difference']):+.2f} ± "
        f"{100 * number(check['standard_error']):.2f} %). Predicted: from ∫F²/p at hits of some pixels, ± its standard "
        "error from their choice; Sobol points beat it. Last column: part of the squared error in the worst 0.1 % of "
        "the pixels."
    )
    head = ["", "technique", "seconds", "per hit", "error", "predicted", "RMSE", "FLIP", "in worst"]
    return Table(f"pictures_{scene}", caption, head, rows, "ll" + "r" * 7)


def _predicted(facts: dict[str, Any]) -> str:
    if "predicted" not in facts:
        return "-"
    return f"{100 * number(facts['predicted']):.3g} ± {100 * number(facts['predicted_error']):.2g} %"
