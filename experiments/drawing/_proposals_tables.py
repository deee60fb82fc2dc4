"""Masses and p-values of printed and corrected forms."""

from __future__ import annotations

import numpy as np
import torch
from scipy.stats import kstwo

from dsfit.checks.chi_square import pooled_chi_square
from dsfit.figures import Data, Table


def p_text(p: float) -> str:
    """A p-value; below 1e-6 it is no matter how small."""
    return "< 1e-6" if p < 1e-6 else f"{p:.2g}"


def forms_table(data: Data) -> Table:
    """Every law: masses, and agreement of samplers with densities."""
    samples = data.record["samples"]
    p = kstwo.sf(data.arrays["distance"], samples)
    rows = [
        [
            law["title"],
            law["equations"],
            law["slip"],
            *(f"{m:.4f}" for m in mass),
            f"{point[0]:.1%}",
            *(p_text(x) for x in row),
        ]
        for law, mass, point, row in zip(
            data.record["laws"], data.arrays["mass"], data.arrays["points"], p, strict=True
        )
    ]
    head = (
        "law", "eq.", "printed form", "mass printed", "mass corrected", "in one point",
        "p: printed samples, printed density", "p: printed samples, corrected density", "p: corrected",
    )  # fmt: skip
    caption = (
        f"Laws as printed and as corrected. Mass: integral of the density over all directions (quadrature); 1 for a "
        f"density. In one point: share of the printed sampler's draws that clamping heaps up there. p: Kolmogorov and "
        f"Smirnov's test of {samples:,} samples against the density brought to mass 1, in the coordinate that the "
        f"figure shows. Small where the sampler does not draw what the density says. Eqs. (7) and (10) are terms of "
        f"the BSDF: their printed form is a sampler that is right for the printed term."
    )
    return Table("forms", caption, head, rows, "lllrrrrrr")


def own_table(data: Data) -> Table:
    """The library's mixtures."""
    p = kstwo.sf(data.arrays["own.distance"], data.record["samples"])
    rows = [
        [name, *(p_text(x) for x in row)]
        for name, row in zip((own["name"] for own in data.record["own"]), p, strict=True)
    ]
    caption = f"The library's own mixtures: {data.record['samples']:,} samples against the marginals of the density."
    return Table("own", caption, ("mixture", "p: θ_i", "p: φ"), rows)


def maps_table(data: Data) -> Table:
    """Chi-square of the maps' cells."""
    rows = []
    for name, mass in zip(data.record["maps"], data.arrays["map.mass"], strict=True):
        observed, expected = (
            torch.as_tensor(data.arrays[f"map.{name}.{key}"].astype(np.float64)) for key in ("observed", "expected")
        )
        p, statistic, degrees = pooled_chi_square(observed, expected * (observed.sum() / expected.sum()))
        rows.append([name, f"{mass - 1:+.0e}".replace("-", "−"), f"{statistic:.0f}", f"{degrees}", p_text(p)])
    caption = (
        f"Proposals over (θ_i, φ): mass of the density, and chi-square of {data.record['map_samples']:,} samples in "
        f"24 × 36 cells against the integral of the density over each; cells of less than 5 expected are pooled."
    )
    return Table("maps", caption, ("proposal", "mass − 1", "χ²", "degrees of freedom", "p"), rows)
