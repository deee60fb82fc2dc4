"""Draws the matrix of response maps, the fitted proposals and ratios beside them, and the turned views."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure

from dsfit.experiment.files import number
from dsfit.figures import Data, Table
from dsfit.figures.page import Page

DECADES = 4
_RATIO_SCALE = LogNorm(0.5, 2.0)
_DARK = 1e-4  # of a map's maximum: what is darker is left white where maps are divided
_KINDS = ("integrand", "fitted", "ratio")
_TITLES = {"integrand": "|F| / ∫|F|", "fitted": "fitted proposal p", "ratio": "|F| / (p ∫|F|)"}


def figures(data: Data, page: Page) -> dict[str, Figure]:
    """The matrix of integrands; for every eccentricity integrand, fit and ratio over n; the same over the view's
    azimuth."""
    record = data.record
    sections, n = _numbers(record["eccentricities"]), _numbers(record["n"])
    matrix = {(e, k): _cell(data, "matrix", e, k) for e in sections for k in n}
    made = {"integrands": _matrix(data, page, matrix, sections, n)}
    bent = [section for section in sections if section != 1]
    if 1.0 in sections and bent:
        made["against-round"] = _against_round(data, page, matrix, bent, n)
    for section in sections:
        cells = [(f"n = {k:g}", matrix[section, k]) for k in n]
        made[f"eccentricity-{section:g}"] = _rows(data, page, cells)
    if record["turned_phi_r_deg"]:
        e, k = number(record["turned_eccentricity"]), number(record["turned_n"])
        cells = [(f"φ_r = {phi:g}°", _cell(data, "turned", e, k, phi)) for phi in _numbers(record["turned_phi_r_deg"])]
        made["azimuths"] = _rows(data, page, cells)
    return made


def captions(data: Data) -> dict[str, str]:
    """What the figures show."""
    record = data.record
    seen = f"{record['preset']} hair seen from θ_r = {number(record['theta_r_deg']):g}°"
    axes = "over the inclination θ_i and the azimuth φ of the light"
    here = f"{seen}, φ_r = {number(record['phi_r_deg']):g}°"
    sections, bent = _numbers(record["eccentricities"]), [e for e in _numbers(record["eccentricities"]) if e != 1]
    rows = (
        "Left: integrand over its integral; middle: density of the mixture fitted to it, on the same scale; right: "
        "their ratio, the weight of a sample over the mean weight, with the excess over the least second moment and "
        "the largest weight, by quadrature."
    )
    found = {
        "integrands": f"Integrand |F| over its integral, {axes}, for sections of {len(sections)} eccentricities (rows) "
        f"and n fibres in front (columns); {here}, constant light; one logarithmic scale of {DECADES} decades. "
        "Scattering among fibres widens the lobes; the section shapes them most where nothing is in front.",
    }
    if 1.0 in sections and bent:
        found["against-round"] = (
            f"Integrand of elliptic sections over that of the round one, each normalised, {axes}; {here}. White beyond "
            f"the lobes: less than {_DARK:g} of the largest value, not divided. Beyond the ends of the scale colours "
            "are cut."
        )
    for section in sections:
        worst = _worst(data, "matrix", section)
        found[f"eccentricity-{section:g}"] = (
            f"The fitted proposal {axes}, section of eccentricity {section:g}; a row for each n; {here}, constant "
            f"light. {rows} The largest excess is {worst[0]:.1e}, the largest weight {worst[1]:.2f}; dark where |F| "
            "is as good as 0."
        )
    if record["turned_phi_r_deg"]:
        worst, e = _worst(data, "turned"), number(record["turned_eccentricity"])
        found["azimuths"] = (
            f"The fitted proposal for views of different azimuth φ_r (rows) about a section of eccentricity {e:g}, "
            f"{axes}; {seen}, n = {number(record['turned_n']):g}. {rows} The largest excess is {worst[0]:.1e}, the "
            f"largest weight {worst[1]:.2f}."
        )
    return found


def _worst(data: Data, which: str, section: float | None = None) -> tuple[float, float]:
    """Largest excess and largest weight of fits."""
    cells = [
        cell["fitted"]
        for key, cell in data.record["cells"].items()
        if key.startswith(f"{which}.") and section in (None, number(cell["eccentricity"]))
    ]
    return tuple(max(number(cell[key]) for cell in cells) for key in ("excess", "largest_weight"))  # type: ignore


def _numbers(values: Sequence[Any]) -> list[float]:
    return [number(x) for x in values]


def _cell(data: Data, which: str, section: float, n: float, phi: float | None = None) -> str:
    """Name of the cell."""
    azimuth = number(data.record["phi_r_deg"]) if phi is None else phi
    return f"{which}.e{section:g}-n{n:g}-phi{azimuth:g}"


def _values(data: Data, name: str, kind: str) -> np.ndarray:
    log = data.arrays[f"{name}.integrand"].astype(np.float64)
    ratio = data.arrays[f"{name}.ratio"].astype(np.float64)
    return 10.0 ** {"integrand": log, "ratio": ratio, "fitted": log - ratio}[kind]


def _scale(data: Data, names: Sequence[str]) -> LogNorm:
    """One logarithmic scale for the densities of a figure: four decades below the largest."""
    most = max(float(_values(data, name, "integrand").max()) for name in names)
    decade = 10.0 ** np.floor(np.log10(most))
    top = next(step for step in (1.0, 2.0, 5.0, 10.0) if step * decade >= 0.999 * most) * decade
    return LogNorm(top * 10.0**-DECADES, top)


def _draw(data: Data, axis: Axes, name: str, kind: str, scale: LogNorm) -> Any:
    norm, colours = (_RATIO_SCALE, "PuOr_r") if kind == "ratio" else (scale, "viridis")
    return _show(data, axis, _values(data, name, kind), norm, colours)


def _show(data: Data, axis: Axes, values: np.ndarray, norm: LogNorm, colours: str) -> Any:
    extent = tuple(float(data.arrays[key][end]) for key in ("phi_deg", "theta_deg") for end in (0, -1))
    values = np.clip(values, norm.vmin, norm.vmax)
    axis.set(xticks=[-180, -90, 0, 90, 180], yticks=[-90, -45, 0, 45, 90])
    axis.set_xticklabels(["−180", "", "0", "", "180"])
    axis.set_yticklabels(["−90", "", "0", "", "90"])
    axis.tick_params(labelsize=7, length=2)
    return axis.imshow(values, norm=norm, cmap=colours, extent=extent, origin="lower", aspect="auto")


def _matrix(
    data: Data, page: Page, cells: dict[tuple[float, float], str], sections: list[float], n: list[float]
) -> Figure:
    """The integrand alone, eccentricity down, n across."""
    figure = page.figure(0.2 * len(sections) + 0.08)
    axes = figure.subplots(len(sections), len(n), sharex=True, sharey=True, squeeze=False)
    scale = _scale(data, list(cells.values()))
    for row, section in enumerate(sections):
        for column, k in enumerate(n):
            image = _draw(data, axes[row, column], cells[section, k], "integrand", scale)
            if row == 0:
                axes[row, column].set_title(f"n = {k:g}")
        axes[row, 0].set_ylabel(f"eccentricity {section:g}\nθᵢ / °", fontsize=8)
    for axis in axes[-1]:
        axis.set_xlabel("φ / °", fontsize=8)
    _bar(figure, image, axes.ravel().tolist(), "|F| / ∫|F|,  sr⁻¹", "vertical")
    return figure


def _against_round(
    data: Data, page: Page, cells: dict[tuple[float, float], str], sections: list[float], n: list[float]
) -> Figure:
    """The integrand of an elliptic section over that of the round one, each normalised."""
    figure = page.figure(0.2 * len(sections) + 0.08)
    axes = figure.subplots(len(sections), len(n), sharex=True, sharey=True, squeeze=False)
    for row, section in enumerate(sections):
        for column, k in enumerate(n):
            images = [_values(data, cells[e, k], "integrand") for e in (section, 1.0)]
            seen = images[1] > _DARK * images[1].max()
            image = _show(
                data, axes[row, column], np.where(seen, images[0] / images[1], np.nan), _RATIO_SCALE, "PuOr_r"
            )
            if row == 0:
                axes[row, column].set_title(f"n = {k:g}")
        axes[row, 0].set_ylabel(f"eccentricity {section:g}\nθᵢ / °", fontsize=8)
    for axis in axes[-1]:
        axis.set_xlabel("φ / °", fontsize=8)
    bar = _bar(figure, image, axes.ravel().tolist(), "over the round one's", "vertical")
    _ratio_ticks(bar)
    return figure


def _rows(data: Data, page: Page, cells: list[tuple[str, str]]) -> Figure:
    """One row for each cell: integrand, fitted proposal, ratio, with the excess and the largest weight."""
    figure = page.figure(0.215 * len(cells) + 0.13)
    axes = figure.subplots(len(cells), 3, sharex=True, sharey=True, squeeze=False)
    scale = _scale(data, [name for _, name in cells])
    images = {}
    for row, (label, name) in enumerate(cells):
        for axis, kind in zip(axes[row], _KINDS, strict=True):
            images[kind] = _draw(data, axis, name, kind, scale)
            if row == 0:
                axis.set_title(_TITLES[kind])
        axes[row, 0].set_ylabel(f"{label}\nθᵢ / °", fontsize=8)
        fitted = data.record["cells"][name]["fitted"]
        text = f"excess {number(fitted['excess']):.1e}, w ≤ {number(fitted['largest_weight']):.2f}"
        axes[row, 2].set_title(f"{_TITLES['ratio']}\n{text}" if row == 0 else text, fontsize=None if row == 0 else 7.5)
    for axis in axes[-1]:
        axis.set_xlabel("φ / °", fontsize=8)
    _bar(figure, images["fitted"], axes[:, :2].ravel().tolist(), "density / sr⁻¹", "horizontal")
    bar = _bar(figure, images["ratio"], axes[:, 2].tolist(), "weight / mean weight", "horizontal")
    _ratio_ticks(bar)
    return figure


def _ratio_ticks(bar: Any) -> None:
    bar.set_ticks([0.5, 0.7, 1, 1.4, 2], labels=["0.5", "0.7", "1", "1.4", "2"])
    bar.minorticks_off()


def _bar(figure: Figure, image: Any, axes: list[Axes], label: str, way: str) -> Any:
    where = "right" if way == "vertical" else "bottom"
    bar = figure.colorbar(image, ax=axes, location=where, aspect=28, shrink=0.8, pad=0.02, extend="both")
    bar.set_label(label, fontsize=8)
    bar.ax.tick_params(labelsize=7)
    return bar


def tables(data: Data) -> list[Table]:
    """Excess of the methods in every cell."""
    made = [_table(data, "matrix", "excess", _where(data, "matrix"))]
    if data.record["turned_phi_r_deg"]:
        made.append(_table(data, "turned", "excess_turned", _where(data, "turned")))
    return made


def _where(data: Data, which: str) -> str:
    record = data.record
    seen = f"{record['preset']} hair seen from θ_r = {number(record['theta_r_deg']):g}°"
    if which == "matrix":
        return f"{seen}, φ_r = {number(record['phi_r_deg']):g}°"
    e, n = number(record["turned_eccentricity"]), number(record["turned_n"])
    return f"{seen}, eccentricity {e:g}, n = {n:g}, turned about its axis"


def _table(data: Data, which: str, name: str, where: str) -> Table:
    rows = []
    for key, cell in sorted(data.record["cells"].items(), key=lambda item: _order(item[1])):
        if not key.startswith(f"{which}."):
            continue
        place = [f"{number(cell[k]):g}" for k in ("eccentricity", "n", "phi_r_deg")]
        excess = [_short(number(cell[method]["excess"])) for method in ("uniform", "mix", "fitted")]
        weights = [f"{number(cell[method]['largest_weight']):.2f}" for method in ("mix", "fitted")]
        mean = f"{number(cell['mean_weight']):.4f} ± {number(cell['mean_weight_error']):.4f}"
        rows.append([*place, *excess, *weights, mean])
    head = ["eccentricity", "n", "φ_r / °", "uniform", "best mix", "fitted", "w, mix", "w, fitted", "mean weight"]
    caption = (
        f"Excess over the least second moment by quadrature, of uniform directions, of the best mix of the chapter's "
        f"heuristics and of the fitted mixture, and the largest weight w of a sample in units of the mean; {where}, "
        "constant light. The last column is the mean weight of directions drawn from the fit, which must be 1."
    )
    return Table(name, caption, head, rows, "r" * len(head))


def _order(cell: dict[str, Any]) -> tuple[float, ...]:
    return tuple(number(cell[key]) for key in ("eccentricity", "n", "phi_r_deg"))


def _short(value: float) -> str:
    return f"{value:.2g}" if value >= 0.01 else f"{value:.1e}"
