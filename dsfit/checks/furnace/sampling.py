"""Findings on proposals: white furnace, ring light, wedges, single samples, and the samplers that must fail them."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch

from dsfit.checks.finding import Finding
from dsfit.checks.furnace.controls import (
    ConstantIntegrand,
    FlippedInclination,
    Folded,
    PermutedRings,
    ScaledDensity,
)
from dsfit.checks.furnace.draws import Draws, draw
from dsfit.checks.furnace.nodes import CAP, NodeDensity, PartitionNodes, Rule, partition_nodes
from dsfit.checks.furnace.partition import Partition
from dsfit.checks.furnace.rings import WeightedCounts, WhiteFurnace, weighted_counts, white_furnace
from dsfit.checks.furnace.weights import SampleWeights, material_consistency, sample_weights
from dsfit.context import Context
from dsfit.material import Material
from dsfit.proposals import Mixture, StructuredProposal, chapter_proposals
from dsfit.proposals.base import Proposal
from dsfit.proposals.printed import PRINTED
from dsfit.proposals.uniform import UniformSphere
from dsfit.random import uniforms
from dsfit.scene.integrand import Integrand

SUITE = "furnace"
ProposalMaker = Callable[[Integrand, Context], dict[str, Proposal]]

LOG_GAP = 1e-6
"""Largest |log p| between what a sampler returns and `log_prob` of its direction."""
MATERIAL = 1e-6
"""Largest relative deviation of a material: unit vectors lose half of the digits of cos(theta_i) at the poles."""
REJECTED = 1e-6
"""A negative control must have a p-value below this."""
_WANTED, _LOOSE, _MOSTLY = 0.12, 0.15, 0.9


def default_proposals(integrand: Integrand, context: Context) -> dict[str, Proposal]:
    """The chapter's proposals, all of them mixed in equal shares, and the structured family as it starts."""
    chapter: dict[str, Proposal] = dict(chapter_proposals(integrand.bsdf, learnable=False))
    mixture = Mixture(list(chapter.values()), learnable=False)
    structured = StructuredProposal(integrand.bsdf, context).requires_grad_(False)
    return {**chapter, "mixture": mixture, "structured": structured}


@dataclass(frozen=True)
class Case:
    """One inclination of the furnace: a context with quadrature nodes, and how tables call it."""

    label: str
    context: Context
    nodes: PartitionNodes


@dataclass(frozen=True)
class Tested:
    """Everything that is known about one proposal in one case."""

    white: WhiteFurnace
    rings: WeightedCounts
    wedges: WeightedCounts
    weights: SampleWeights
    beside: float
    sup: float


@dataclass
class Record:
    """Arrays for the plots, grown proposal by proposal; what a case lacks stays NaN."""

    rows: dict[tuple[int, str], Tested] = field(default_factory=dict)

    def arrays(self, prefix: str, cases: int) -> dict[str, np.ndarray]:
        """Estimates and weighted counts as `[cases, proposals, ...]`, with the proposals' names."""
        names = list(dict.fromkeys(name for _, name in self.rows))
        if not names:
            return {}
        found: dict[str, np.ndarray] = {f"{prefix}_names": np.array(names)}
        for (k, name), tested in self.rows.items():
            at = k, names.index(name)
            parts = {
                "estimate": tested.white.estimate,
                "standard_error": tested.white.standard_error,
                **{f"ring_{key}": getattr(tested.rings, key) for key in ("expected", "sampled", "standard_error")},
                **{f"wedge_{key}": getattr(tested.wedges, key) for key in ("expected", "sampled", "standard_error")},
            }
            for key, value in parts.items():
                whole = np.full((cases, len(names), len(value)), np.nan)
                found.setdefault(f"{prefix}_{key}", whole)[at] = value.numpy()
        return found


def furnace_case(integrand: Any, context: Context, label: str, partition: Partition) -> Case:
    """Quadrature of the furnace over every cell of the partition."""
    return Case(label, context, partition_nodes(integrand, context, partition))


def judge_proposal(integrand: Any, case: Case, proposal: Proposal, samples: int, generator: torch.Generator) -> Tested:
    """All tests of one proposal in one case, from one set of samples.

    Where p leaves out part of the integrand, or some weight exceeds 40 times the mean, half of the samples are drawn
    from the uniform sphere instead and the weights are those of the mixture: a proposal for one lobe is not meant to
    be used alone, and alone it has no standard error to judge by. Where the quadrature says that `samples` would leave
    a standard error of the furnace above 12 %, up to eight times as many are drawn.
    """
    with torch.no_grad():
        density = case.nodes.with_density(proposal(case.context).log_prob)
    sup = density.largest_weight()
    beside = 0.0 if sup <= CAP else 0.5
    samples = _enough(density, beside, samples)
    draws = draw(integrand, proposal, case.context, samples, generator=generator, beside=beside)
    return _tested(density, draws, beside, sup)


def _enough(density: NodeDensity, beside: float, samples: int) -> int:
    """Samples that the furnace needs, between 1 and 8 times `samples`; decided before any is drawn."""

    def columns(rule: Rule, p: torch.Tensor) -> torch.Tensor:
        norm, mixed = torch.linalg.vector_norm(rule.value, dim=-1), (1 - beside) * p + beside / (4 * math.pi)
        return torch.stack([norm, torch.where(norm > 0, norm * norm / mixed, 0.0)], dim=-1)

    total, second = density.integrate(columns)[0].sum(0).tolist()
    needed = (second / total**2 - 1) / _WANTED**2 if total > 0 else 0.0
    return samples * min(8, max(1, math.ceil(needed / samples))) if math.isfinite(needed) else samples


def _tested(density: NodeDensity, draws: Draws, beside: float, sup: float) -> Tested:
    partition = density.nodes.partition
    return Tested(
        white=white_furnace(density, draws),
        rings=weighted_counts(density, draws, partition.rings()),
        wedges=weighted_counts(density, draws, partition.wedges()),
        weights=sample_weights(draws),
        beside=beside,
        sup=sup,
    )


def integrand_findings(case: Case) -> Iterator[Finding]:
    """The furnace by quadrature, value per channel and bound; and whether F is negative or not finite anywhere."""
    sums, bounds = case.nodes.integrate(lambda rule: rule.value)
    value, error = sums.sum(0), bounds.sum(0)
    shown = ", ".join(f"{x:.4f}" for x in value.tolist())
    yield Finding(
        SUITE, "white furnace by quadrature", case.label,
        value=float((error / value.abs().clamp_min(1e-300)).max()), bound=1e-3,
        unclear=None if case.nodes.converged else "the quadrature did not converge",
        detail=f"int F cos(theta_i) domega = {shown}",
        data={"value": value.tolist(), "error": error.tolist()},
    )  # fmt: skip
    values = case.nodes.fine.value
    bad = float((~(values.isfinite() & (values >= 0)).all(-1)).double().mean())
    yield Finding(
        SUITE, "F is finite and not negative", case.label, value=bad, bound=0.0,
        detail=f"{bad:.1%} of {len(values)} nodes are not",
    )  # fmt: skip


def proposal_findings(name: str, case: Case, tested: Tested) -> Iterator[Finding]:
    """Four findings of one proposal in one case."""
    how = "alone" if tested.beside == 0 else "beside the uniform sphere"
    white, weights = tested.white, tested.weights
    relative = float((white.standard_error / white.value.abs().clamp_min(1e-300)).max())
    z = float(white.z[white.z.abs().argmax()])
    yield Finding(
        SUITE, f"white furnace: {name}", case.label, p_value=white.p_value,
        unclear=f"standard error of {relative:.0%}" if relative > _LOOSE and white.p_value > REJECTED else None,
        detail=f"z = {z:.2f}, standard error {relative:.2%}, {how}",
        data={"z": white.z.tolist(), "standard_error": relative, "beside": tested.beside},
    )  # fmt: skip
    for kind, counts in (("ring light", tested.rings), ("azimuthal wedges", tested.wedges)):
        unclear = None
        if counts.p_value > REJECTED and (counts.degrees == 0 or counts.untested > _MOSTLY):
            unclear = f"{counts.untested:.0%} of the light is in cells that are hit too rarely"
        yield Finding(
            SUITE, f"{kind}: {name}", case.label, p_value=counts.p_value, unclear=unclear,
            detail=f"chi-square {counts.statistic:.1f} over {counts.degrees}, {how}",
            data={"statistic": counts.statistic, "degrees": counts.degrees, "untested": counts.untested},
        )  # fmt: skip
    sup = f"sup F / p at nodes {tested.sup:.3g}" if math.isfinite(tested.sup) else "p leaves out part of the integrand"
    yield Finding(
        SUITE, f"single samples: {name}", case.label,
        value=weights.log_gap if weights.faults == 0 else math.inf, bound=LOG_GAP,
        detail=f"largest weight {weights.largest:.3g} means, {sup}, {weights.faults} faults",
        data={"largest": weights.largest, "sup": tested.sup if math.isfinite(tested.sup) else None,
              "faults": weights.faults},
    )  # fmt: skip


def material_findings(
    integrand: Integrand,
    case: Case,
    name: str,
    proposal: Proposal,
    sup: float,
    samples: int,
    generator: torch.Generator,
) -> Iterator[Finding]:
    """f, sample_f and pdf of `dsfit.Material` on unit vectors, and PBRT's estimator against quadrature, which it
    can be judged by where `sup`, the largest weight in units of the mean, is not too large."""
    context = case.context
    material = Material(integrand.bsdf, proposal, context.n, context.v, integrand.scattering)
    u = uniforms((samples,), proposal(context).dimension, generator=generator)
    rule = case.nodes.fine
    omega = rule.omega[:: max(1, len(rule.omega) // 500)]
    sums, _ = case.nodes.integrate(lambda r: r.value)
    found = material_consistency(material, integrand, context, u, omega, sums.sum(0))
    yield Finding(
        SUITE, f"material: {name}", case.label, value=found.deviation, bound=MATERIAL,
        detail="f |n . wi| is F cos(theta_i); sample_f agrees with f and pdf",
    )  # fmt: skip
    worst = float(found.z.abs().max())  # type: ignore[union-attr]
    relative = float((found.standard_error / found.estimate.abs().clamp_min(1e-300)).max())
    yield Finding(
        SUITE, f"material, PBRT's estimator: {name}", case.label,
        p_value=-math.expm1(len(found.estimate) * math.log1p(-math.erfc(worst / math.sqrt(2)) * (1 - 1e-16))),
        unclear=None if sup <= CAP and relative <= _LOOSE else f"weights up to {sup:.3g} means, error {relative:.0%}",
        detail=f"mean of f |n . wi| / pdf: z = {worst:.2f}, standard error {relative:.2%}",
    )  # fmt: skip


def controls(proposals: dict[str, Proposal]) -> dict[str, Proposal]:
    """Samplers that are wrong: the chapter's as printed, and slips put into right ones."""
    right = proposals.get("structured") or next(iter(proposals.values()))
    sphere = proposals.get("uniform") or right
    return {
        **{name: kind() for name, kind in PRINTED.items()},
        "flipped_theta": FlippedInclination(right),
        "flipped_theta_consistent": FlippedInclination(right, consistent=True),
        "permuted_rings": PermutedRings(sphere),
        "folded": Folded(sphere),
        "scaled_density": ScaledDensity(right, 1.25),
    }


def control_findings(record: Record) -> Iterator[Finding]:
    """Each control's smallest p-value over tests and cases, times their number."""
    for name in dict.fromkeys(name for _, name in record.rows):
        several = [tested for (_, other), tested in record.rows.items() if other == name]
        p_values = [p for t in several for p in (t.white.p_value, t.rings.p_value, t.wedges.p_value)]
        smallest = [min(getattr(t, kind).p_value for t in several) for kind in ("white", "rings", "wedges")]
        yield Finding(
            SUITE, f"control: {name}", "negative control", value=min(1.0, min(p_values) * len(p_values)),
            bound=REJECTED, detail="rejected: white furnace p = {:.1e}, rings {:.1e}, wedges {:.1e}".format(*smallest),
            data={"white": smallest[0], "rings": smallest[1], "wedges": smallest[2]},
        )  # fmt: skip


def total_only_findings(context: Context, partition: Partition, samples: int, seed: int) -> Iterator[Finding]:
    """A sampler that is right only in total: its furnace is exact for a constant integrand, its rings are not."""
    integrand = ConstantIntegrand()
    case = furnace_case(integrand, context, "constant integrand", partition)
    for name, control in (("permuted_rings", PermutedRings), ("folded", Folded)):
        generator = torch.Generator().manual_seed(seed)
        found = judge_proposal(integrand, case, control(UniformSphere()), samples, generator)
        exact = abs(float(found.white.estimate[0] / found.white.value[0]) - 1)
        yield Finding(
            SUITE, f"control: {name} passes the furnace", "constant integrand", value=exact, bound=1e-6,
            detail="its weights add up to the right total wherever its directions go",
        )  # fmt: skip
        yield Finding(
            SUITE, f"control: {name} fails the rings", "constant integrand", value=found.rings.p_value,
            bound=REJECTED, detail=f"chi-square {found.rings.statistic:.3g} over {found.rings.degrees}",
        )  # fmt: skip
