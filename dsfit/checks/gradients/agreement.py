"""Whether a Monte Carlo gradient has the mean that quadrature gives, in standard errors; and planted faults that must
not."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from dsfit.checks.gradients.estimators import (
    GradientEstimate,
    Problem,
    Stratum,
    path_strata,
    pathwise_of,
    score_rows,
    summary,
)
from dsfit.checks.gradients.moment import ExactMoment

MOST_LEVERAGE = 0.1
"""A parameter is judged where no single sample makes up more than this share of the sum of squares."""
POWER = 7.0
"""Standard errors by which a fault has to move some component for the data to be able to reject it at 1e-6."""


@dataclass(frozen=True)
class Agreement:
    """A Monte Carlo gradient against that of quadrature.

    Attributes:
        p_value: of the largest |z| among the judged parameters, Šidák-corrected for their number; 1 if there is none.
        z: `[P]`, deviation beyond the quadrature's error bound, in standard errors.
        judged: `[P]`.
        worst: label of the parameter with the largest |z|.
        relative_error: norm of the standard error over that of the gradient.
    """

    p_value: float
    z: Tensor
    judged: Tensor
    worst: str
    relative_error: float


def agreement(estimate: GradientEstimate, exact: ExactMoment, among: Tensor | None = None) -> Agreement:
    """Compare all components; `among` restricts the comparison to some.

    Components are correlated, so that Šidák's correction errs on the side of a pass. One that is zero for every sample
    has no standard error, and must be zero to rounding.
    """
    gap = ((estimate.mean - exact.gradient).abs() - exact.error).clamp_min(0.0)
    constant = estimate.error <= 1e-12 * exact.moment
    z = torch.where(constant, torch.where(gap <= 1e-9 * exact.moment, 0.0, torch.inf), gap / estimate.error)
    judged = constant | (estimate.leverage <= MOST_LEVERAGE)
    judged = judged if among is None else judged & among
    relative = float(torch.linalg.vector_norm(estimate.error)) / max(exact.size, 1e-300)
    if not bool(judged.any()):
        return Agreement(1.0, z, judged, "", relative)
    seen = torch.where(judged, z.nan_to_num(nan=torch.inf), -1.0)
    k = int(seen.argmax())
    single = torch.special.erfc(seen[k] / 2**0.5)
    joint = -torch.expm1(int(judged.sum()) * torch.log1p(-single.clamp_max(1 - 1e-16)))
    return Agreement(float(joint), z, judged, exact.labels[k], relative)


@dataclass(frozen=True)
class PlantedFault:
    """What a wrong gradient was given.

    Attributes:
        name: of the fault.
        p_value: of the wrong gradient.
        power: standard errors by which the fault moves the component that shows it best, as far as it is known.
    """

    name: str
    p_value: float
    power: float


def planted_faults(
    problem: Problem, exact: ExactMoment, samples: int, generator: torch.Generator, strata: list[Stratum] | None = None
) -> list[PlantedFault]:
    """Gradients that are wrong on purpose, from the same samples as the right ones.

    | fault | what is wrong | moves the mean by |
    |---|---|---|
    | sign of the score | +h s | -2 dM |
    | factor 2 | dh . dT - h s: |F|^2 / p in place of |F|^2 / p^2 | -dM |
    | no dlog p | the density in the weight held fixed | -2 dM |
    | detached samples | omega held fixed while p^2 is differentiated | dM + D |
    | weights | selection of components left out, D = sum_k dw_k E_k[h] | -D |
    """
    h, score = score_rows(problem, samples, generator)
    strata = path_strata(problem, samples, generator) if strata is None else strata
    gradient = exact.gradient
    switch = sum((s.slope * s.h.mean() for s in strata), torch.zeros_like(gradient))
    still = [replace(s, slope=torch.zeros_like(s.slope)) for s in strata]
    fixed = [replace(s, moved=torch.zeros_like(s.moved)) for s in strata]
    wrong = [
        ("sign of the score", summary("", [(1.0, h[:, None] * score)], 0.0), -2 * gradient),
        ("factor 2", pathwise_of([replace(s, score=s.score / 2) for s in strata]), -gradient),
        ("no dlog p", pathwise_of([replace(s, score=torch.zeros_like(s.score)) for s in strata]), -2 * gradient),
        ("detached samples", pathwise_of(fixed), gradient + switch),
    ]
    if len(strata) > 1 and bool(switch.abs().max() > 0):
        wrong.append(("weights", pathwise_of(still), -switch))
    faults = []
    for name, estimate, moved in wrong:
        usable = (estimate.leverage <= MOST_LEVERAGE) & (estimate.error > 1e-12 * exact.moment)
        reach = torch.where(usable, (moved.abs() - exact.error) / estimate.error, 0.0)
        faults.append(PlantedFault(name, agreement(estimate, exact).p_value, float(reach.max())))
    return faults
