"""Findings of the suite `gradients` about gradients of the second moment."""

from __future__ import annotations

import time
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from dsfit.checks.finding import Finding
from dsfit.checks.gradients.agreement import POWER, Agreement, PlantedFault, agreement, planted_faults
from dsfit.checks.gradients.derivative_findings import SUITE
from dsfit.checks.gradients.estimators import (
    ESTIMATORS,
    GradientEstimate,
    Problem,
    Stratum,
    path_strata,
    pathwise_of,
)
from dsfit.checks.gradients.jumps import Jumps, find_jumps
from dsfit.checks.gradients.moment import ExactMoment, defended, learnable, moment_gradient, parts_of
from dsfit.checks.subject import Say, Subject
from dsfit.proposals import chapter_proposals
from dsfit.quality import reference

MOST_ERROR = 0.25
"""Standard error over the gradient, both in norm, beyond which an estimate cannot tell right from wrong."""


def moment_findings(
    subject: Subject, samples: int, defensive: float, moments: str | Sequence[str], say: Say
) -> tuple[list[Finding], dict[str, np.ndarray]]:
    """Monte Carlo gradients of the second moment against quadrature, and planted faults."""
    generator = torch.Generator().manual_seed(subject.seed + 1)
    chapter = set(chapter_proposals(subject.integrand.bsdf)) | {"mixture", "structured"}
    norm = float(reference(subject.integrand, subject.context, 1e-5).norm)
    findings: list[Finding] = []
    arrays: dict[str, np.ndarray] = {}
    faults: dict[str, tuple[PlantedFault, str]] = {}
    names = []
    for name, given in subject.proposals.items():
        wanted = moments == "all" or name in moments or name not in chapter
        proposal = defended(learnable(given), defensive)
        if not wanted or not any(p.requires_grad for p in proposal.parameters()):
            continue
        say(f"gradients of the second moment of {name}")
        problem = Problem(subject.integrand, proposal, subject.context, norm)
        exact = moment_gradient(subject.integrand, proposal, subject.context, norm=norm)
        estimates, strata = estimate_all(problem, exact, samples, generator)
        jumps = jumps_of(problem)
        for estimate in estimates:
            findings += _moment_findings(estimate, exact, strata, jumps, f"{name} {estimate.name}", subject.label)
        for fault in planted_faults(problem, exact, samples, generator, strata):
            if fault.name not in faults or fault.power > faults[fault.name][0].power:
                faults[fault.name] = (fault, name)
        arrays |= _arrays(len(names), exact, estimates)
        names.append(name)
    for fault, name in faults.values():
        findings.append(_fault_finding(fault, name, subject.label))
    return findings, {**arrays, "names": np.array(names), "estimators": np.array(list(ESTIMATORS))}


def estimate_all(
    problem: Problem, exact: ExactMoment, samples: int, generator: torch.Generator
) -> tuple[list[GradientEstimate], list[Stratum]]:
    """Every estimator, and the samples of the pathwise one; again with up to four times the samples where the standard
    error is too large to tell."""
    estimates = []
    strata: list[Stratum] = []

    def paths(problem: Problem, count: int, generator: torch.Generator) -> GradientEstimate:
        nonlocal strata
        began = time.perf_counter()
        strata = path_strata(problem, count, generator)
        return pathwise_of(strata, time.perf_counter() - began)

    for function in {**ESTIMATORS, "pathwise": paths}.values():
        function(problem, 64, generator)  # what is made once is not timed
        estimate = function(problem, samples, generator)
        relative = float(torch.linalg.vector_norm(estimate.error)) / max(exact.size, 1e-300)
        if relative > MOST_ERROR:
            estimate = function(problem, min(4, 1 + int((relative / MOST_ERROR) ** 2)) * samples, generator)
        estimates.append(estimate)
    return estimates, strata


def jumps_of(problem: Problem) -> tuple[Jumps, Jumps]:
    """Jumps of |F| / p along theta and phi."""
    distribution = problem.proposal(problem.context)

    def weight(omega: Tensor) -> Tensor:
        return torch.sqrt(problem.square(omega)) * torch.exp(-distribution.log_prob(omega))

    return find_jumps(weight, 0), find_jumps(weight, 1)


def _moment_findings(
    estimate: GradientEstimate,
    exact: ExactMoment,
    strata: list[Stratum],
    jumps: tuple[Jumps, Jumps],
    name: str,
    case: str,
) -> list[Finding]:
    crossing = torch.zeros(len(exact.labels), dtype=torch.bool)
    if estimate.name == "pathwise":
        for axis, jump in enumerate(jumps):
            if jump.count:
                crossing |= torch.stack([s.turned[axis] > 0 for s in strata]).any(0)
    found = agreement(estimate, exact, ~crossing)
    unclear = None
    if not exact.converged:
        unclear = "the quadrature did not converge"
    elif found.relative_error > MOST_ERROR:
        unclear = f"the standard error is {found.relative_error:.0%} of the gradient"
    elif not bool(found.judged.any()):
        unclear = "no parameter can be judged: single samples make up its standard error, or samples cross jumps"
    relative = max(exact.size, 1e-300) ** 2
    data = {
        "relative_error": found.relative_error,
        "noise": estimate.noise / relative,
        "cost_us": estimate.cost / relative,
        "samples": estimate.samples,
        "judged": int(found.judged.sum()),
        "parameters": len(exact.labels),
    }
    subject, detail = f"d second moment, {name}", _moment_detail(estimate, exact, found)
    first = Finding(SUITE, subject, case, p_value=found.p_value, unclear=unclear, detail=detail, data=data)
    if not bool(crossing.any()):
        return [first]
    largest = max(jumps, key=lambda j: j.largest)
    gap = ((estimate.mean - exact.gradient).abs() / estimate.error.clamp_min(1e-300))[crossing]
    known = (
        f"paths do not see that |F|/p jumps by {largest.largest:.0%}, as at theta {np.degrees(largest.at[0]):.0f} and"
        f" azimuth {np.degrees(largest.at[1]):.0f} degrees, where these parameters move samples across"
    )
    off = f"{int(crossing.sum())} parameters, off by up to {float(gap.max()):.1f} standard errors"
    return [first, Finding(SUITE, f"{subject} across jumps", case, unclear=known, detail=off)]


def _moment_detail(estimate: GradientEstimate, exact: ExactMoment, found: Agreement) -> str:
    noise = estimate.noise / max(exact.size, 1e-300) ** 2
    return (
        f"{int(found.judged.sum())} of {len(exact.labels)} parameters, standard error {found.relative_error:.1%} of the"
        f" gradient, variance of a sample {noise:.3g}, x time {estimate.cost / max(exact.size, 1e-300) ** 2:.3g} us"
    )


def _fault_finding(fault: PlantedFault, name: str, case: str) -> Finding:
    unclear = None
    if fault.power < POWER:
        unclear = f"no power: the fault moves the mean by {fault.power:.1f} standard errors only"
    detail = f"at {name}, where it moves the mean by {fault.power:.0f} standard errors"
    return Finding(
        SUITE, f"control: {fault.name}", case, value=fault.p_value, bound=1e-6, unclear=unclear, detail=detail
    )


def _arrays(index: int, exact: ExactMoment, estimates: list[GradientEstimate]) -> dict[str, np.ndarray]:
    return {
        f"labels_{index}": np.array(parts_of(exact.labels)),
        f"exact_{index}": exact.gradient.numpy(),
        f"mean_{index}": torch.stack([e.mean for e in estimates]).numpy(),
        f"error_{index}": torch.stack([e.error for e in estimates]).numpy(),
        f"noise_{index}": np.array([e.noise for e in estimates]) / max(exact.size, 1e-300) ** 2,
        f"cost_{index}": np.array([e.cost for e in estimates]) / max(exact.size, 1e-300) ** 2,
    }
