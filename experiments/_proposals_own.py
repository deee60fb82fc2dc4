"""The library's own mixtures in one dimension: density, components and samples beside |F|."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from dsfit.bsdf.dual_scattering import DualScattering
from dsfit.context import Context
from dsfit.fit import fit
from dsfit.proposals.amortised import AmortisedProposal
from dsfit.proposals.base import Proposal
from dsfit.proposals.mixture import MixtureDistribution
from dsfit.proposals.structured import StructuredProposal
from dsfit.scene.integrand import Integrand
from experiments._proposals_measure import EVERY, Size, distance, draw, kept, marginal, quantiles

OWN_AXES = ("theta", "forward")
Say = Callable[[str], None]


def own_proposals(bsdf: DualScattering, context: Context, steps: int) -> dict[str, Proposal]:
    """The structured mixture as it starts and after at most `steps` of a fit, and the amortised one untrained."""
    start = StructuredProposal(bsdf, context)
    fitted = fit(start, Integrand(bsdf), context, max_steps=steps).proposal
    assert isinstance(fitted, StructuredProposal)
    return {"structured": start, "fitted": fitted, "amortised": AmortisedProposal(bsdf)}


def components(proposal: Proposal) -> list[str]:
    """Names of a mixture's components; the last is its defensive share."""
    assert isinstance(proposal, StructuredProposal | AmortisedProposal)
    return [*proposal.names, "uniform"]


def measure_own(
    bsdf: DualScattering, own: Mapping[str, Proposal], context: Context, samples: int, bins: int, seed: int, say: Say
) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Arrays `own.NAME.AXIS.*` with `parts` (weight times density of every component), `own.target.AXIS`; and
    distances of samples from densities `[mixtures, axes]`."""
    found: dict[str, np.ndarray] = {}
    for axis in OWN_AXES:
        law = marginal(Size(Integrand(bsdf), context), context, axis)
        found[f"own.target.{axis}"] = (law.density / law.mass)[::EVERY].astype(np.float32)
        found[f"own.target_cdf.{axis}"] = (law.cdf / law.mass)[::EVERY].astype(np.float32)
    distances = np.zeros((len(own), len(OWN_AXES)))
    for k, (name, proposal) in enumerate(own.items()):
        say(f"{name}: marginals")
        distribution = proposal(context)
        for j, axis in enumerate(OWN_AXES):
            law = marginal(distribution, context, axis)
            drawn = draw(distribution, context, axis, samples, seed + 7919 * (2 * k + j))
            shown = quantiles(distribution, context, axis)
            found |= kept(f"own.{name}.{axis}", law, shown, drawn, axis, bins)
            found[f"own.{name}.{axis}.parts"] = _parts(distribution, context, axis)
            distances[k, j] = distance(drawn, law)
    return found, distances


def _parts(distribution: MixtureDistribution, context: Context, axis: str) -> np.ndarray:
    """Weight times marginal density of every component at every second kept point, `[K, P]`."""
    intervals = 720 // (2 * EVERY)
    rows = [marginal(part, context, axis, intervals).density for part in distribution.components]
    weights = distribution.log_weights.exp().detach().numpy()
    return (weights[:, None] * np.stack(rows)).astype(np.float32)
