"""Captions of the figures of proposals."""

from __future__ import annotations

import numpy as np

from dsfit.figures import Data


def captions(data: Data) -> dict[str, str]:
    """What the figures show."""
    record, samples = data.record, f"{data.record['samples']:,} samples"
    theta_r, n, v = record["context"]
    where = f"{record['preset']} hair, θ_r = {theta_r:g}°, n = {n:g}, v = {v:g}"
    found = {}
    for page in dict.fromkeys(law["page"] for law in record["laws"]):
        own = [k for k, law in enumerate(record["laws"]) if law["page"] == page]
        mass = data.arrays["mass"][own]
        titles = list(dict.fromkeys(record["laws"][k]["title"].split(",")[0] for k in own))
        off = float(np.abs(mass[:, 1] - 1).max())
        printed = " to ".join(dict.fromkeys(f"{x:.3g}" for x in (mass[:, 0].min(), mass[:, 0].max())))
        target = any(f"{record['laws'][k]['name']}.target" in data.arrays for k in own)
        found[page] = (
            f"{', '.join(titles)}: densities as printed (first column) and corrected (second), with histograms of "
            f"{samples} of the sampler of the same form, bars ± 2 standard errors; distribution functions, and "
            f"inverses over the random number u (printed: line, corrected: dashed). {record['preset'].capitalize()} "
            f"hair; rows: law, equations of the chapter, what is wrong in print. Masses: {printed} as printed, within "
            f"{_power(off)} of 1 as corrected" + (". Dashed black: what the law is for." if target else ".")
        )
    found["own"] = (
        f"The library's mixtures, {where}: marginals in inclination and azimuth, as it starts, fitted, and amortised. "
        f"First column: components (colours), their sum (blue) and |F| / ∫|F| (dashed) on a logarithmic scale; second: "
        f"the sum with a histogram of {samples}, bars ± 2 standard errors, beside |F|; then distribution functions "
        "and inverses over the random number u."
    )
    found["maps"] = (
        f"All proposals over (θ_i, φ), {where}; three maps each: probability of cells, counts of "
        f"{record['map_samples']:,} samples, both over the largest probability, and the residual in standard errors "
        "of the counts. Residuals without a pattern say that sampler and density agree; the last, the printed sampler "
        "of the cosine lobe, is the one that does not."
    )
    return found


def _power(value: float) -> str:
    """An upper bound that is a power of ten."""
    return f"1e{int(np.ceil(np.log10(max(value, 1e-15))))}"
