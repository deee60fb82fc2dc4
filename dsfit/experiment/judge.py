"""How good all methods of a cell are, by one adaptive cubature: the integrand, which costs most, is evaluated once
for all of them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from dsfit.experiment.methods import Plan, Setting
from dsfit.frame import wrap
from dsfit.mis.estimators import control_variates
from dsfit.mis.heuristics import heuristic, log_effective
from dsfit.mis.optimal import quadrature_alpha
from dsfit.mis.variance import MisVariance, mis_variance

RTOL = 1e-3
FLOOR = 1e-4
"""Excess below this is resolved to RTOL times this, not to RTOL."""
MAX_EVALUATIONS = 1_000_000


def judge(plans: Sequence[Plan], setting: Setting, reference: Any) -> list[dict[str, float]]:
    """Excess, its error bound, largest weight and relative variance per sample of every plan.

    With P = sum_s c_s p_s and p* = |F| / ∫|F|, the second moment per sample is, in units of M*,

        1 + ∫ (p* - P)^2 / P + ∫ p*^2 (sum_s w_s^2 / (c_s p_s) - 1 / P);

    the last integral is 0 for the balance heuristic and a single proposal. What fixed sample counts per strategy gain
    is subtracted; it comes from the nodes. For the optimal heuristic, alpha comes from the nodes and the variance
    with that alpha, `∫ |F - alpha.p|^2 / P`, is what counts; its excess, (N Var + |I|^2) / M* - 1, can be negative.
    All integrals are adaptive, over half the azimuth where F is even. The excess is inf for a method without density
    somewhere where F is not 0 (it is biased) and where its density falls to 0 at phi = pi, as cos(phi/2) does, but F
    does not: then ∫ F^2 / P diverges.
    """
    judged = {id(plan): _NOTHING for plan in plans}
    sound = [plan for plan in plans if _covers(plan, setting)]
    if sound:
        judged |= _integrate(sound, setting, reference)
    return [judged[id(plan)] for plan in plans]


_NOTHING = {"excess": math.inf, "excess_error": 0.0, "largest_weight": math.inf, "variance": math.inf}


def _integrate(plans: list[Plan], setting: Setting, reference: Any) -> dict[int, dict[str, float]]:
    from dsfit.quality import _cubature

    first = [_from_nodes(plan, setting) for plan in plans]
    norm, m_star = float(reference.norm), float(reference.m_star)
    integral = float(reference.value.square().sum())
    shift = 1 - integral / m_star  # of the optimal heuristic: excess = ∫ |F - alpha.p|^2 / P / M* - shift
    units = []  # what each column is divided by, so that all columns are of order 1
    for plan, nodes in zip(plans, first, strict=True):
        guess = float(nodes.excess)
        if plan.heuristic_name == "optimal":
            plan.alpha = _alpha(plan, setting)
            guess = float(nodes.variance_excess) + shift
        units.append(FLOOR + (max(guess, FLOOR) if math.isfinite(guess) else 1.0))
    even = setting.integrand.is_even
    largest = torch.zeros(len(plans), dtype=torch.float64)

    def columns(omega: Tensor, value: Tensor) -> Tensor:
        value = value / norm
        target = torch.linalg.vector_norm(value, dim=-1)
        sides = [omega]
        if even:  # F is the same at phi and -phi, but a density need not be
            phi = wrap(setting.context.phi_r - omega[..., 1])
            sides.append(torch.stack([omega[..., 0], wrap(setting.context.phi_r + phi)], dim=-1))
        total = torch.zeros(len(omega), len(plans) + 1, dtype=torch.float64)
        for side in sides:
            known: dict[int, Tensor] = {}
            for k, plan in enumerate(plans):
                gap, ratio = _gap(plan, setting, side, value, norm, known)
                total[:, k] += (gap + FLOOR * target) / units[k] / len(sides)
                largest[k] = torch.maximum(largest[k], ratio.max())
        total[:, -1] = target
        return total

    with torch.no_grad():
        found = _cubature(setting.integrand, setting.context, columns, RTOL, MAX_EVALUATIONS, even)
    judged = {}
    for k, (plan, nodes) in enumerate(zip(plans, first, strict=True)):
        excess = float(found.value[k]) * units[k] - FLOOR
        if plan.alpha is not None:
            excess -= shift
        elif plan.model == "multi":
            excess -= float(nodes.excess - nodes.variance_excess)
        error = float(found.error[k]) * units[k]
        judged[id(plan)] = {
            "excess": excess,
            "excess_error": error,
            "largest_weight": float(largest[k]),
            "variance": (m_star * (1 + excess) - integral) / integral,
        }
    return judged


def _covers(plan: Plan, setting: Setting) -> bool:
    """Whether the density is positive wherever F is, as far as the nodes and the edge phi = pi tell."""
    log_p = setting.log_p(plan.strategies)
    alive = (log_p > -torch.inf).any(dim=0)
    if not bool((alive | (setting.nodes.norm == 0)).all()):
        return False
    context = setting.context
    theta = torch.linspace(-1.5, 1.5, 31, dtype=torch.float64)
    edge = torch.stack([theta, wrap(context.phi_r - math.pi).expand_as(theta)], dim=-1)
    beside = edge + torch.tensor([0.0, 0.1], dtype=torch.float64)
    with torch.no_grad():
        vanishes = plan.density(edge, context) < 1e-12 * plan.density(beside, context)
        lit = torch.linalg.vector_norm(setting.integrand(edge, context), dim=-1) > 0
    return not bool((vanishes & lit).any())


def _from_nodes(plan: Plan, setting: Setting) -> MisVariance:
    nodes = setting.fine_nodes
    with torch.no_grad():
        log_p = setting.log_p(plan.strategies, nodes)
        counts = torch.tensor(plan.fractions, dtype=log_p.dtype)
        return mis_variance(nodes.value, nodes.weight, log_p, counts, plan.heuristic, model=plan.model)


def _alpha(plan: Plan, setting: Setting) -> Tensor:
    """Coefficients `[S, C]` of the optimal heuristic from the nodes."""
    nodes, log_p = setting.fine_nodes, setting.log_p(plan.strategies, setting.fine_nodes)
    fractions = torch.tensor(plan.fractions, dtype=log_p.dtype)
    mix = torch.exp(torch.logsumexp(log_effective(log_p, fractions), dim=0))
    return quadrature_alpha(
        nodes.value / mix[:, None], control_variates(log_p, fractions), nodes.weight * mix, fractions
    )


def _gap(
    plan: Plan, setting: Setting, omega: Tensor, value: Tensor, norm: float, known: dict[int, Tensor]
) -> tuple[Tensor, Tensor]:
    """Integrand of the excess (see `judge`), and p* / P, at directions `[Q, 2]` with F / ∫|F| = value; `known` are
    log densities there."""
    for s in plan.strategies:
        if id(s) not in known:
            known[id(s)] = setting.distribution(s).log_prob(omega)
    target = torch.linalg.vector_norm(value, dim=-1)
    log_p = torch.stack([known[id(s)] for s in plan.strategies])
    fractions = torch.tensor(plan.fractions, dtype=log_p.dtype)
    log_q = log_effective(log_p, fractions)
    log_mix = torch.logsumexp(log_q, dim=0)
    density = torch.exp(log_mix)
    ratio = torch.where(target > 0, target / density, 0.0)
    if plan.alpha is not None:
        control = torch.exp(log_p).T @ (plan.alpha / norm)
        return (value - control).square().sum(-1) / density, ratio
    gap = torch.where(target > 0, (ratio - 1) * (target - density), density)
    if len(plan.strategies) > 1 and plan.heuristic_name != "balance":
        log_w = heuristic(plan.heuristic).log_weights(log_p, fractions)
        used = log_w > -torch.inf
        inverse = torch.exp(torch.where(used, 2 * log_w - torch.where(used, log_q, 0.0) + log_mix, -torch.inf)).sum(0)
        gap = gap + torch.where(target > 0, target * ratio * (inverse - 1), 0.0)
    return gap, ratio
