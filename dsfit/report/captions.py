"""What one sees in the figures of a run, by their file names."""

from __future__ import annotations

import re
from typing import Any

Caption = tuple[str, str]
"""Name for people, and what one sees."""

_FIGURES: dict[str, Caption] = {
    "image": ("The picture", "The rendered picture, tone-mapped; the radiance itself is in the EXR file."),
    "n": ("Scatter counts", "Fibres that the light has passed on its way to each pixel's hair, n, mean over the hits."),
    "variance": (
        "Variance",
        "Variance of each pixel's radiance, mean over the channels, from the spread of the passes; logarithmic.",
    ),
    "time": ("Time", "CPU time that each pixel took, in milliseconds."),
    "convergence": (
        "Error against run time",
        "Relative root mean square error against seconds per estimate, a panel for each context. Points are measured, "
        "with one standard error and the quartiles of the time; lines are what quadrature predicts; dashed lines "
        "start with the time of the fit. The dotted level is an error of 1 %.",
    ),
    "excess": (
        "Excess",
        "Excess (N Var + |I|²) / M* − 1 of every method by quadrature: 0 is the limit of any single density, lower is "
        "better.",
    ),
    "sweep": (
        "Excess over the grid",
        "Excess against the last axis of the grid, a line for each value of the first axis, a panel for each method. "
        "Contexts that share a grid point are summarised by their median.",
    ),
    "maps": (
        "Densities and weights",
        "Above: |F| / ∫|F| and every proposal's density over the sphere of incident directions, one logarithmic scale. "
        "Below: their ratio, the weight of a sample in units of the mean weight; white is 1, a perfect proposal is "
        "white everywhere.",
    ),
    "transmittance": (
        "Fitted Gaussians against n",
        "Width and centre of the Gaussian fitted to the transmittance a_f(θ)^n against the number n of fibres passed, "
        "a colour for each fibre; on the right the excess, solid for width and centre fitted, dashed for the width "
        "alone, dotted for the chapter's cosine.",
    ),
    "shapes": (
        "Laws of the transmittance",
        "What passes n fibres, a_f(θ)^n, and the laws that stand for it: the chapter's cosine and the fitted Gaussian.",
    ),
    "race": (
        "Error against run time",
        "Relative root mean square error against CPU seconds, with 95 % bands: the stream on the left, single contexts "
        "on the right; above everything counted, below already prepared. Dotted curves understate their error (heavy "
        "tails); crosses are peers whose estimates are off the truth. Dotted levels are 1 % and 0.1 %.",
    ),
    "amortised": (
        "Excess at contexts not trained on",
        "Excess of the amortised proposals over inclination and n, for two rules of v, and the share of contexts below "
        "an excess, trained (solid) and as it starts (dotted).",
    ),
    "curves": (
        "Error against run time",
        "Relative error of the picture against CPU seconds, slopes in brackets: left already prepared, right with "
        "preparation counted. Solid with Sobol points, dashed with random ones; hollow marks where light is sampled "
        "too; dotted where a few pixels decide the error. The grey line is the reference's own error.",
    ),
    "equal_time-crops": (
        "Equal time, details",
        "A detail of every technique's picture after the same CPU time; below it the relative error, logarithmic from "
        "1 % to 100 %. The reference comes last.",
    ),
    "equal_time-pictures": (
        "Equal time",
        "Every technique's picture after the same CPU time; below it the relative error, logarithmic from 1 % to "
        "100 %. The reference comes last.",
    ),
    "equal_samples-crops": (
        "Equal samples, details",
        "A detail of every technique's picture after equally many directions; below it the relative error, logarithmic "
        "from 1 % to 100 %. The reference comes last.",
    ),
    "equal_samples-pictures": (
        "Equal samples",
        "Every technique's picture after equally many directions; below it the relative error, logarithmic from 1 % to "
        "100 %. The reference comes last.",
    ),
    "chi_square": ("p-values", "p-values of all χ² tests, sorted, and the level that they are held to."),
    "chi_square-": (
        "Samples against the density",
        "Counts of samples per square degree: what the cell-integrated density expects, what was observed, and their "
        "difference in units of √expected, for a test that failed or, where none did, for the least likely one.",
    ),
    "furnace": (
        "White furnace",
        "Energy that comes back under constant light: quadrature and estimates for each channel above, all proposals' "
        "estimates over quadrature below.",
    ),
    "rings": ("Ring light", 
        "Samples over what quadrature expects in narrow rings of incident light: above the right samplers, below "
        "planted wrong ones, which must stand out.",
    ),
    "gradients": (
        "Gradients of the variance",
        "Gradients with respect to every parameter of each proposal, with one standard error, by estimator; on the "
        "right their variance times time.",
    ),
    "independent": (
        "Independent samples",
        "Marginals of θ_i and φ from ensemble MCMC and from resampling, and the p-values of every proposal's "
        "comparisons.",
    ),
    "controls": (
        "Controls",
        "Left: how clearly the printed form of each corrected equation is rejected, in decades of p or of deviation "
        "over bound; the bar is what is needed. Right: the integral as printed over the right one.",
    ),
    "stability": ("Stability", "Errors of the library's functions over their arguments, by precision and quantity."),
    "stability-naive-value": ("Naive formulas: values", "The formula as first written beside the library's: values."),
    "stability-naive-gradient": (
        "Naive formulas: gradients",
        "The formula as first written beside the library's: gradients.",
    ),
    "stiff_fits": (
        "Stiff fits",
        "What is left of the way from the start to the best known value, a row for each problem and objective, a "
        "column for each solver.",
    ),
}  # fmt: skip
_ORDER = {name: k for k, name in enumerate(_FIGURES)}


def _key(stem: str) -> str:
    """Name of the entry that describes a figure; empty if none does."""
    if stem in _FIGURES:
        return stem
    base = stem.split("-")[0]
    if base == "chi_square":
        return "chi_square-"
    return base if re.fullmatch(r"[a-z_]+-\d{4}", stem) and base in _FIGURES else ""


def order(stem: str) -> tuple[int, str]:
    """Sorts figures as their descriptions stand here, unknown ones last."""
    return _ORDER.get(_key(stem), len(_ORDER)), stem


def caption(stem: str, result: dict[str, Any]) -> Caption:
    """Name of a figure of a run and what one sees."""
    key = _key(stem)
    if not key:
        return stem, ""
    name, text = _FIGURES[key]
    where = _label(stem, result)
    return (f"{name}: {where}" if where else name), text


def _label(stem: str, result: dict[str, Any]) -> str:
    """The label of the cell that a figure's number names."""
    number = re.search(r"-(\d{4})(?:-(.*))?$", stem)
    cells = result.get("cells")
    if not number or not isinstance(cells, list):
        return ""
    found = next((c for c in cells if isinstance(c, dict) and c.get("index") == int(number[1])), {})
    label = str(found.get("label", ""))
    return f"{label}, {number[2]}" if number[2] and label else label
