"""Every estimator against the reference by quadrature: each proposal beside the uniform sphere, and all of them
together under every MIS heuristic, in the multi-sample and in the one-sample model.

Chapter eqs (1)-(3). What chi-square cannot see, this does: MIS weights that do not sum to one, an integrand and a
density in different measures, counts that do not match the weights.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from scipy import stats
from torch import Tensor

from dsfit.checks.finding import Finding
from dsfit.checks.subject import Outcome, Say, Subject, silent
from dsfit.context import Context
from dsfit.proposals.base import Proposal
from dsfit.proposals.uniform import UniformSphere
from dsfit.quality import Reference, reference
from dsfit.scene.integrand import Integrand

SUITE = "unbiased"
MODELS = ("multi", "one")
HEURISTICS = ("balance", "power", "maximum", "cutoff", "optimal")
MOST_ERROR = 0.1  # relative standard error beyond which agreement proves nothing
BLOCKS = 32
_FEWEST = 4


@dataclass(frozen=True)
class Agreement:
    """An estimate beside the quadrature.

    Attributes:
        p_value: of Hotelling's test over the channels, from `BLOCKS` independent estimates.
        z: largest deviation of a channel in standard errors.
        relative_error: largest standard error of a channel, relative to the reference.
        truth_error: largest error bound of the reference, in standard errors.
        claimed: standard error that the estimates claim over that of their spread, mean over channels.
    """

    p_value: float
    z: float
    relative_error: float
    truth_error: float
    claimed: float = math.nan


def agreement(
    integrand: Integrand,
    proposals: Sequence[Proposal],
    context: Context,
    truth: Reference,
    samples: int,
    heuristic: str = "balance",
    model: str = "multi",
    *,
    generator: torch.Generator,
) -> Agreement:
    """Compare the mean of `BLOCKS` independent estimates with the reference, all channels at once.

    Hotelling's T-squared with the covariance of the blocks; channels that depend on each other completely (a grey
    fibre) leave a singular covariance, whose null directions are left out.

    Args:
        integrand: what is integrated.
        proposals: strategies, in equal shares.
        context: a single context.
        truth: the reference at this context.
        samples: in all.
        heuristic, model: as `dsfit.estimate` takes them.
        generator: of all random numbers.
    """
    from dsfit.mis import estimate

    many = context.expand(BLOCKS)
    found = estimate(
        integrand, list(proposals), many, samples // BLOCKS, heuristic, generator=generator, model=model, test=False
    )
    claimed = torch.sqrt(found.standard_error.square().mean(dim=0) / found.value.var(dim=0).clamp_min(1e-300)).mean()
    return replace(hotelling(found.value, truth.value, truth.error), claimed=float(claimed))


def hotelling(values: Tensor, truth: Tensor, truth_error: Tensor) -> Agreement:
    """Agreement of independent estimates `[B, C]` of one mean with `truth` `[C]`."""
    blocks = len(values)
    gap = values.mean(dim=0) - truth
    covariance = torch.atleast_2d(torch.cov(values.T)) / blocks
    error = torch.sqrt(covariance.diagonal())
    scale = torch.where(error > 0, error, 1.0)
    share, axes = torch.linalg.eigh(covariance / (scale[:, None] * scale))
    kept = share > 1e-6 * share.max().clamp_min(1e-300)
    along = ((gap / scale) @ axes)[kept]
    rank = int(kept.sum())
    squared = float((along**2 / share[kept]).sum())
    p_value = float(stats.f.sf(squared * (blocks - rank) / (rank * (blocks - 1)), rank, blocks - rank))
    return Agreement(
        p_value=p_value if math.isfinite(squared) else math.nan,
        z=float((gap / scale).abs().max()),
        relative_error=float((error / truth.abs().clamp_min(1e-300)).max()),
        truth_error=float((truth_error / scale).max()),
    )


def z_test(values: Tensor, truth: float) -> float:
    """Two-sided p-value that many independent values `[N]` have this mean; normal by their number."""
    z = (float(values.mean()) - truth) / (float(values.std()) / math.sqrt(len(values)))
    return float(2 * stats.norm.sf(abs(z)))


def run(
    subject: Subject,
    *,
    say: Say = silent,
    samples: int = 40_000,
    heuristics: Sequence[str] = HEURISTICS,
    rtol: float = 1e-5,
) -> Outcome:
    """Each proposal with the uniform sphere under the balance heuristic, and all proposals under each heuristic."""
    say("reference")
    integrand, context = subject.integrand, subject.context
    with torch.no_grad():
        truth = reference(integrand, context, rtol)
        if not float(truth.norm) > 0:
            unclear = "the integrand is zero"
            return Outcome([Finding(SUITE, "reference", subject.label, unclear=unclear)])
        uniform = UniformSphere()
        cases = [(name, [proposal, uniform], "balance") for name, proposal in subject.proposals.items()]
        together = [*subject.proposals.values(), uniform]
        cases += [("all", together, heuristic) for heuristic in heuristics]
        outcome, claimed = Outcome(), []
        for k, ((name, strategies, heuristic), model) in enumerate(itertools.product(cases, MODELS)):
            say(f"{name}: {heuristic}, {model}")
            generator = torch.Generator().manual_seed(subject.seed + 104_729 * k)
            found = agreement(integrand, strategies, context, truth, samples, heuristic, model, generator=generator)
            outcome.findings.append(_finding(f"{name}, {heuristic}, {model}-sample", subject.label, found))
            if found.relative_error < MOST_ERROR:
                claimed.append(found.claimed)
    outcome.findings.append(_claimed(claimed, subject.label))
    return outcome


def _claimed(ratios: list[float], case: str) -> Finding:
    """Whether estimates know their own error: the ratio of one case scatters by 1/sqrt(2 `BLOCKS`), their median by
    less."""
    found = sorted(ratios)[len(ratios) // 2] if ratios else math.nan
    return Finding(
        SUITE,
        "claimed standard errors",
        case,
        value=max(found, 1 / found) if found > 0 else math.inf,
        bound=1 + 1.25 * 5 / math.sqrt(2 * BLOCKS * max(len(ratios), 1)),
        unclear=None if len(ratios) >= _FEWEST else f"{len(ratios)} estimates of small error: too few to judge theirs",
        detail=f"claimed over measured: median {found:.3f} of {len(ratios)} estimators",
        data={"ratios": ratios},
    )


def _finding(subject: str, case: str, found: Agreement) -> Finding:
    unclear = None
    if not found.relative_error < MOST_ERROR:
        unclear = f"standard error {found.relative_error:.0%} of the value: agreement would prove nothing"
    elif found.truth_error > 0.2:
        unclear = f"the reference is known to {found.truth_error:.2g} standard errors only"
    detail = f"z {found.z:.2f}, standard error {found.relative_error:.2%}"
    data = {"z": found.z, "relative_error": found.relative_error}
    return Finding(SUITE, subject, case, p_value=found.p_value, unclear=unclear, detail=detail, data=data)


__all__ = ["Agreement", "agreement", "hotelling", "run", "z_test"]
