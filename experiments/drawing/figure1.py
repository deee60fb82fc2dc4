"""Draws attenuation over inclination, the densities that a_f^n makes of it, and the fits over n."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from dsfit.experiment.files import number
from dsfit.experiment.plots.style import COLORS, MARKERS
from dsfit.figures import Data, Table
from dsfit.figures.page import Page

COSINE_STD_DEG = 39.17  # of cos(theta) / 2 on [-90, 90]: sqrt(pi^2 / 4 - 2) radians
_GREY = "#555555"
_TALLEST = 0.05  # per degree; higher densities are cut
_POWERS = {0.0: "per radian, a_f^n", 1.0: "per solid angle, a_f^n cosθ", 2.0: "with eq. (4)'s cosine, a_f^n cos²θ"}


def figures(data: Data, page: Page) -> dict[str, Figure]:
    """Averages, densities, fits."""
    return {"averages": _averages(data, page), "densities": _densities(data, page), "fits": _fits(data, page)}


def captions(data: Data) -> dict[str, str]:
    """What the figures show."""
    record, arrays = data.record, data.arrays
    presets, n = record["presets"], arrays["n"]
    excess = {name: arrays[f"{name}.fit.excess"] for name in presets}
    clear = [name for name in presets if np.isfinite(number(record["width"][name]["limit_deg"]))]
    worst = max((float(excess[name].max()) for name in clear), default=float("nan"))
    cosine = [float(arrays[f"{name}.fit.excess_cosine"][-1]) for name in presets]
    back = [100 * number(record["claims"][name]["back_share_0"]) for name in presets]
    slopes = ", ".join(f"{name} {number(record['width'][name]['slope']):.2f}" for name in presets)
    return {
        "averages": "Averaged attenuation of forward (a_f) and backward (a_b) scattering by one fibre, and the share "
        "that goes back, over the inclination of the light. Lines: means over the channels, bands: from the least to "
        "the largest channel. They carry the cosine of the incident light, as published, so that both vanish at ±90°. "
        f"At 0° {presets[-1]} hair sends {back[-1]:.0f} % of what it scatters back, {presets[0]} hair {back[0]:.0f} %.",
        "densities": "What n fibres leave of light that is the same from everywhere: the law a_f^n (filled) as a "
        "density of the inclination, the Gaussian fitted to it (dashed), and the chapter's cosine law (33), which is "
        "the same for every n (dotted); rows: fibres, means over channels; columns: n. Densities above "
        f"{_TALLEST:g} per degree are cut, with their largest value. Where a_f has its peak in the middle, a_f^n "
        "becomes a narrow Gaussian; where absorption is strong, most passes at grazing inclinations.",
        "fits": f"Gaussians fitted to a_f^n for n = {n[0]:g} to {n[-1]:g}: width with the limit that the curvature of "
        "the peak predicts (dotted), centre (hollow marks: at its bound), and excess over the least second moment, "
        f"beside that of the cosine law (dotted); all by quadrature. Exponents of the width from "
        f"n = {number(record['slope_from']):g} on: {slopes}. The Gaussian's excess is {worst:.2g} at most for "
        f"{', '.join(clear)}; that of the cosine law is {min(cosine):.1f} to {max(cosine):.0f} at the largest n.",
    }


def _averages(data: Data, page: Page) -> Figure:
    """a_f, a_b and the share that goes back; bands from the least to the largest channel."""
    figure = page.figure(0.46)
    axes = figure.subplots(1, 3)
    theta = data.arrays["theta_deg"]
    inner = slice(1, -1)  # at +-90 degrees both vanish, and so does their quotient
    for color, name in zip(COLORS, data.record["presets"], strict=False):
        forward, backward = data.arrays[f"{name}.a_f"], data.arrays[f"{name}.a_b"]
        for axis, values in zip(axes, (forward, backward, backward / (forward + backward)), strict=True):
            values = values[inner]
            axis.fill_between(theta[inner], values.min(-1), values.max(-1), color=color, alpha=0.25, linewidth=0)
        means = forward.mean(-1), backward.mean(-1)
        lines = (*means, means[1] / (means[0] + means[1]))
        for axis, values in zip(axes, lines, strict=True):
            axis.plot(theta[inner], values[inner], color=color, label=name, linewidth=1.3)
    axes[0].set(title="forward, a_f", ylabel="share of the light", ylim=(0, 0.85))
    axes[1].set(title="backward, a_b", ylim=(0, None))
    axes[2].set(title="a_b / (a_f + a_b)", ylim=(0, 1))
    for axis in axes:
        _over_theta(axis)
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=4, frameon=False)
    return figure


def _over_theta(axis: Axes) -> None:
    axis.set(xlabel="θ / °", xlim=(-90, 90), xticks=np.arange(-90, 91, 45))
    axis.grid(True)


def _densities(data: Data, page: Page) -> Figure:
    """One row per fibre, one column per n: the law, the fitted Gaussian and the chapter's cosine."""
    presets, shown = data.record["presets"], data.record["shown_n"]
    figure = page.figure(0.24 * len(presets) + 0.06)
    axes = figure.subplots(len(presets), len(shown), sharex=True, sharey="row", squeeze=False)
    theta = data.arrays["theta_deg"]
    for row, (color, name) in enumerate(zip(COLORS, presets, strict=False)):
        for column, n in enumerate(shown):
            axis = axes[row, column]
            axis.fill_between(theta, data.arrays[f"{name}.density"][column], color=color, alpha=0.35, linewidth=0)
            axis.plot(theta, data.arrays[f"{name}.gaussian"][column], "--", color="black", linewidth=1.1)
            axis.plot(theta, data.arrays["cosine"], ":", color=_GREY, linewidth=1.3)
            _over_theta(axis)
            axis.set(xlabel="", xticklabels=["−90", "", "0", "", "90"])
            highest = float(data.arrays[f"{name}.density"][column].max())
            if highest > _TALLEST:
                axis.text(
                    0.98, 0.95, f"up to {highest:.2g}", transform=axis.transAxes, ha="right", va="top", fontsize=7
                )
            if row == 0:
                axis.set_title(f"n = {number(n):g}")
        high = max(float(data.arrays[f"{name}.density"].max()), float(data.arrays["cosine"].max()))
        axes[row, 0].set(ylabel=name, ylim=(0, 1.08 * min(high, _TALLEST)))
    for axis in axes[-1]:
        axis.set_xlabel("θ / °")
    figure.supylabel("density / degree⁻¹", fontsize=9)
    power = number(data.record["cosines"])
    law = "a_f(θ)ⁿ, normalised" if power == 0 else f"a_f(θ)ⁿ cosθ^{power:g}, normalised"
    styles = (("-", "black", "fitted Gaussian"), (":", _GREY, "cosθ/2, eq. (33), for every n"))
    handles: list[Any] = [Line2D([], [], color=_GREY, alpha=0.4, linewidth=6, label=law)]
    handles += [Line2D([], [], linestyle="--" if k == 0 else s, color=c, label=label)
                for k, (s, c, label) in enumerate(styles)]  # fmt: skip
    figure.legend(handles=handles, loc="outside lower center", ncols=3, frameon=False)
    return figure


def _fits(data: Data, page: Page) -> Figure:
    """Width (with its limit law), centre and excess over n; hollow marks: the parameter ended at its bound."""
    figure = page.figure(0.58)
    widths, centres, excesses = figure.subplots(1, 3)
    n = data.arrays["n"]
    for k, name in enumerate(data.record["presets"]):
        color, bounds = COLORS[k], data.record["at_bounds"][name]

        def line(axis: Axes, key: str, style: str, bound: str = "", k=k, name=name, color=color, bounds=bounds) -> None:
            values = data.arrays[f"{name}.fit.{key}"]
            axis.plot(n, values, style, color=color, linewidth=1.1)
            if style == "-":
                faces = ["white" if bound in at else color for at in bounds]
                axis.scatter(n, values, 14, c=faces, edgecolors=color, marker=MARKERS[k], linewidths=0.8, zorder=3)

        line(widths, "width_deg", "-", "width")
        line(centres, "centre_deg", "-", "centre")
        line(excesses, "excess", "-")
        line(excesses, "excess_cosine", ":")
        limit = number(data.record["width"][name]["limit_deg"])
        if np.isfinite(limit):
            widths.plot(n, limit / np.sqrt(n), linestyle=(0, (1, 2)), color=color, linewidth=0.9)
    widths.axhline(COSINE_STD_DEG, color=_GREY, linewidth=1.0, linestyle="--")
    widths.set(title="width / °", yscale="log", ylim=(3, 400), yticks=[3, 10, 30, 100, 300])
    widths.set_yticklabels(["3", "10", "30", "100", "300"])
    centres.axhline(0, color=_GREY, linewidth=1.0, linestyle="--")
    centres.set(title="centre / °", ylim=(-95, 20), yticks=[-90, -60, -30, 0])
    excesses.set(title="excess", yscale="log")
    for axis in (widths, centres, excesses):
        axis.set(xscale="log", xlabel="fibres passed, n")
        axis.grid(True)
    figure.legend(handles=_fit_legend(data), loc="outside lower center", ncols=4, frameon=False, columnspacing=1.2)
    return figure


def _fit_legend(data: Data) -> list[Line2D]:
    handles = [
        Line2D([], [], color=COLORS[k], marker=MARKERS[k], markersize=3.8, linewidth=1.1, label=name)
        for k, name in enumerate(data.record["presets"])
    ]
    handles.append(Line2D([], [], color="black", linewidth=1.1, label="fitted Gaussian"))
    handles.append(Line2D([], [], color="black", linestyle=":", linewidth=1.1, label="cosθ/2 (excess)"))
    handles.append(Line2D([], [], color="black", linestyle=(0, (1, 2)), linewidth=0.9, label="peak's limit, ∝ 1/√n"))
    handles.append(Line2D([], [], color=_GREY, linestyle="--", linewidth=1.0, label="of cosθ/2 (width, centre)"))
    return handles


def tables(data: Data) -> list[Table]:
    """The claims, the fits, and the excess in three measures."""
    return [_claims(data), _fit_table(data), _measures(data)]


def _claims(data: Data) -> Table:
    """One row per claim and fibre."""
    presets, claims = data.record["presets"], data.record["claims"]
    clear = claims[presets[0]]
    grazing, near = f"{number(clear['grazing_deg']):g}°", f"{number(data.record['near_deg']):g}°"
    low, high = (f"{number(x):g}" for x in clear["n"])
    checks: list[tuple[str, Callable[[dict[str, Any]], tuple[bool, str]]]] = [
        ("less goes forward than through nonabsorbing hair", lambda c: _less(c, clear)),
        ("more goes back towards ±90°: a_b", _back),
        (f"... as a share of a_f + a_b, 0° to {grazing}", lambda c: _rises(c, "back_share")),
        (f"... as a share of what arrives, 0° to {grazing}", lambda c: _rises(c, "outgoing_a_b")),
        (f"part of ∫a_f^n within ±{near} grows, n = {low} to {high}", _concentrates),
        ("colour leaves the scattering as it is", lambda c: _alike(c, clear)),
    ]
    rows = []
    for text, check in checks:
        base = check in (checks[0][1], checks[-1][1])
        for k, name in enumerate(presets):
            true, numbers = check(claims[name])
            rows.append([text if k == 0 else "", name, "-" if base and k == 0 else "yes" if true else "no", numbers])
    caption = (
        "What the caption and the text around the chapter's figure 1 claim, and what the averages say (means over "
        "channels; the mean forward shift α_f from its least to its largest channel). The averages carry the cosine of "
        "the incident light, as published, so that both vanish at ±90°: a_b itself falls again before, and only the "
        "share that goes back keeps growing. With the cosine of the outgoing light instead, a_b is a share of the "
        "light that arrives."
    )
    return Table("claims", caption, ["claim", "fibre", "true", "measured"], rows, "lllr")


def _less(c: dict[str, Any], clear: dict[str, Any]) -> tuple[bool, str]:
    ratio = number(clear["a_f_0"]) / number(c["a_f_0"])
    return ratio > 1, f"a_f(0) {number(c['a_f_0']):.3f}, {ratio:.3g} times less"


def _back(c: dict[str, Any]) -> tuple[bool, str]:
    first, most, last = (number(c[key]) for key in ("a_b_0", "a_b_most", "a_b_last"))
    where = f"{most:.3f} at {number(c['a_b_most_deg']):.0f}°"
    return last >= most, f"{first:.3f} at 0°, {where}, {last:.3f} at {number(c['a_b_last_deg']):g}°"


def _rises(c: dict[str, Any], key: str) -> tuple[bool, str]:
    low, high = number(c[f"{key}_0"]), number(c[f"{key}_grazing"])
    fall = number(c["back_share_falls_by"]) if key == "back_share" else 0.0
    return high > low, f"{low:.3f} to {high:.3f}" + (f", falls by {fall:.3f} between" if fall > 1e-3 else "")


def _concentrates(c: dict[str, Any]) -> tuple[bool, str]:
    low, high = (100 * number(x) for x in c["near_of_all"])
    return high > low, f"{low:.0f} % to {high:.1f} %"


def _alike(c: dict[str, Any], clear: dict[str, Any]) -> tuple[bool, str]:
    low, high = (number(x) for x in c["alpha_f_deg"])
    share, of_clear = number(c["back_share_0"]), number(clear["back_share_0"])
    angle = f"{low:.1f}°" if high - low < 0.05 else f"{low:.1f}° to {high:.1f}°"
    return abs(share - of_clear) < 0.01 * of_clear, f"α_f(0) {angle}, {100 * share:.1f} % back"


def _fit_table(data: Data) -> Table:
    n = data.arrays["n"]
    wanted = [k for k, x in enumerate(n) if x in (1, 2, 5, 10, 20, 50, 100, 400)] or list(range(len(n)))
    rows = []
    for name in data.record["presets"]:
        fit = {key: data.arrays[f"{name}.fit.{key}"] for key in ("width_deg", "centre_deg", "excess", "excess_cosine")}
        for k in wanted:
            at = " *" if data.record["at_bounds"][name][k] else ""
            row = [f"{n[k]:g}", f"{fit['width_deg'][k]:.1f}", f"{fit['centre_deg'][k]:.1f}"]
            rows.append([name, *row, f"{fit['excess'][k]:.2g}" + at, f"{fit['excess_cosine'][k]:.2g}"])
    from_n = number(data.record["slope_from"])
    laws = "; ".join(_law(name, data.record["width"][name]) for name in data.record["presets"])
    caption = (
        f"Gaussians fitted to a_f^n. Exponents of width over n from n = {from_n:g} on, and √n times the width at the "
        f"largest n against what the peak's curvature predicts: {laws}. *: a parameter of the fit (centre, or the "
        "width of the centred law) is at its bound, because a_f^n is no hill around the normal plane."
    )
    return Table("fits", caption, ["fibre", "n", "width / °", "centre / °", "excess, Gaussian", "excess, cosθ/2"], rows)


def _law(name: str, law: dict[str, Any]) -> str:
    limit = number(law["limit_deg"])
    predicted = f"{limit:.0f}°" if np.isfinite(limit) else "no peak"
    return f"{name} {number(law['slope']):.3f} ({number(law['last_deg']):.0f}° against {predicted})"


def _measures(data: Data) -> Table:
    shown = [f"{number(n):g}" for n in data.record["shown_n"]]
    rows = []
    for name in data.record["presets"]:
        for one in data.record["measures"][name]:
            power = number(one["cosines"])
            text = _POWERS.get(power, f"a_f^n cosθ^{power:g}")
            pairs = zip(one["cosine"], one["gaussian"], strict=True)
            rows.append([name, text, *(f"{number(c):.2g} / {number(g):.2g}" for c, g in pairs)])
    caption = (
        "Excess of cosθ/2 (33) / of the best Gaussian, where a_f^n is counted per radian of θ, per solid angle, and "
        "with the integrand's cosine, which is the measure that an estimate of the integral sees. As a density of the "
        "light's inclination, (33) with a uniform azimuth is the uniform sphere, 1/(4π) per steradian: it weighs "
        "nothing by a_f."
    )
    return Table("measures", caption, ["fibre", "measure", *(f"n = {n}" for n in shown)], rows, "ll" + "r" * len(shown))
