"""Variance of a MIS combination by quadrature, and the fractions that make it least: no Monte Carlo noise."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from dsfit.errors import InputError, check_choice
from dsfit.mis.estimators import control_variates
from dsfit.mis.heuristics import Balance, Optimal, log_effective
from dsfit.mis.heuristics import heuristic as as_heuristic
from dsfit.mis.optimal import quadrature_alpha


@dataclass(frozen=True)
class MisVariance:
    """What `mis_variance` returns; batch shape `[*batch]`.

    Fields:
        variance: of the combined estimate with these counts, `[*batch, C]`.
        integral: ∫F by the same nodes, `[*batch, C]`.
        excess: N sum_s 1/n_s ∫ w_s^2 |F|^2 / p_s / M* - 1 with M* = (∫|F|)^2, `[*batch]`: the second moment per sample.
            One strategy, or balance with fractions c (density P = sum c p), gives exactly the excess of that density.
        variance_excess: (N Var + |∫F|^2) / M* - 1, `[*batch]`, Var the sum over channels: the excess of a single
            density with the same variance per sample. Never above `excess`: the difference is what fixed counts per
            strategy gain over a random choice. The one to compare for the optimal heuristic, which minimises the
            variance and not the second moment.
        m_star: (∫|F|)^2 by the same nodes, `[*batch]`.
    """

    variance: Tensor
    integral: Tensor
    excess: Tensor
    variance_excess: Tensor
    m_star: Tensor


def mis_variance(
    nodes_value: Tensor,
    nodes_weight: Tensor,
    log_p: Tensor,
    counts: Tensor | Sequence[float],
    heuristic: Any = "balance",
    *,
    model: str = "multi",
) -> MisVariance:
    """Variance of a MIS estimate from quadrature nodes.

    Multi-sample: `Var = sum_s 1/n_s (∫ w_s^2 F^2 / p_s - (∫ w_s F)^2)` (Veach 1997, section 9.2). One-sample, with
    N = sum of counts: `Var = 1/N (sum_s ∫ w_s^2 F^2 / (c_s p_s) - (∫F)^2)`. Differentiable in counts and densities.

    Args:
        nodes_value: F at the nodes `[Q, *batch, C]`.
        nodes_weight: solid-angle weights `[Q]` or `[Q, *batch]`: sum_q w f = ∫ f.
        log_p: log densities per steradian `[S, Q, *batch]`; the nodes must see every peak and tail of F^2 / p.
        counts: n_s `[S]`, >= 0; may be fractions, then everything is per sample.
        heuristic: name, mapping or object. The optimal heuristic's alpha comes from the same nodes.
        model: "multi" or "one".

    Raises:
        InputError: bad counts or model, or a node where F is not 0 but no strategy with samples has density.

    Example:
        >>> import torch
        >>> import dsfit
        >>> from dsfit.mis.variance import mis_variance
        >>> from dsfit.proposals import UniformSphere
        >>> cosine = dsfit.FunctionIntegrand(lambda omega, context: torch.cos(omega[..., :1]))
        >>> nodes = dsfit.quadrature_nodes(cosine, dsfit.Context(0.0), 1e-5)
        >>> log_p = UniformSphere()(dsfit.Context(0.0)).log_prob(nodes.omega)[None]
        >>> round(float(mis_variance(nodes.value, nodes.weight, log_p, [1]).excess), 5)
        0.08076
    """
    check_choice("model", model, ("multi", "one"))
    rule = as_heuristic(heuristic)
    counts = torch.as_tensor(counts, dtype=log_p.dtype, device=log_p.device)
    log_q = log_effective(log_p, counts)
    total = counts.sum()
    fractions = counts / total
    weight = nodes_weight.reshape(*nodes_weight.shape, *[1] * (log_p.ndim - 1 - nodes_weight.ndim))
    norm = torch.linalg.vector_norm(nodes_value, dim=-1)
    dead = (log_q.detach() == -torch.inf).all(dim=0) & (norm.detach() > 0) & (weight > 0)
    if bool(dead.any()):
        raise InputError("log_p", "all densities with samples are 0 at a node where F is not", "full support")

    optimal = isinstance(rule, Optimal)
    log_weights = (Balance() if optimal else rule).log_weights(log_p, fractions)
    if optimal:
        residual, alpha = _optimal_residual(nodes_value, weight, log_p, fractions, log_weights, rule)
    second, squared_means, integral = 0.0, 0.0, (nodes_value * weight.unsqueeze(-1)).sum(dim=0)
    for s in torch.nonzero(counts.detach()).flatten().tolist():
        # root = sqrt(p_s) z and first = p_s z for z = w_s F / (c_s p_s)
        if optimal:
            z = residual + (alpha.sum(dim=-2) if model == "one" else alpha[..., s, :] / fractions[s])
            root, first = z * torch.exp(0.5 * log_p[s]).unsqueeze(-1), z * torch.exp(log_p[s]).unsqueeze(-1)
        else:
            live = torch.isfinite(log_weights[s]) & (norm.detach() > 0)
            log_root = torch.where(live, log_weights[s], 0.0) - 0.5 * torch.where(live, log_p[s], 0.0)
            root = nodes_value * (torch.exp(torch.where(live, log_root, -torch.inf)) / fractions[s]).unsqueeze(-1)
            first = nodes_value * (torch.exp(log_weights[s]) / fractions[s]).unsqueeze(-1)
        second = second + fractions[s] * (root.square() * weight.unsqueeze(-1)).sum(dim=0)
        if model == "multi":
            squared_means = squared_means + fractions[s] * (first * weight.unsqueeze(-1)).sum(dim=0).square()
    squared_means = squared_means if model == "multi" else integral.square()
    per_sample = second - squared_means
    m_star = (norm * weight).sum(dim=0).square()
    return MisVariance(
        variance=per_sample / total,
        integral=integral,
        excess=second.sum(dim=-1) / m_star - 1,
        variance_excess=(per_sample.sum(dim=-1) + integral.square().sum(dim=-1)) / m_star - 1,
        m_star=m_star,
    )


def _optimal_residual(
    value: Tensor, weight: Tensor, log_p: Tensor, fractions: Tensor, log_balance: Tensor, rule: Optimal
) -> tuple[Tensor, Tensor]:
    """(F - alpha . p) / P `[Q, *batch, C]` and alpha `[*batch, S, C]`."""
    log_mix = torch.logsumexp(log_effective(log_p, fractions), dim=0)
    live = torch.isfinite(log_balance).any(dim=0)
    inverse = torch.exp(torch.where(live, -torch.where(live, log_mix, 0.0), -torch.inf))
    g, r = value * inverse.unsqueeze(-1), control_variates(log_p, fractions)
    alpha = quadrature_alpha(g, r, weight * torch.exp(log_mix), fractions, rule.rcond)
    return g - torch.einsum("q...s,...sc->q...c", r, alpha), alpha


def best_fractions(
    nodes_value: Tensor,
    nodes_weight: Tensor,
    log_p: Tensor,
    heuristic: Any = "balance",
    *,
    model: str = "multi",
    costs: Sequence[float] | None = None,
    minimum: float = 0.0,
    steps: int = 100,
) -> tuple[Tensor, float]:
    """Fractions `[S]` of least variance x cost, and that variance as a mean `variance_excess` over the batch.

    Minimises `log mean_batch(N Var / M*) + log sum_s c_s cost_s` over `c = minimum + (1 - S minimum) softmax(x)` by
    L-BFGS, from equal fractions, keeping the best point seen. The balance heuristic's one-sample problem is convex (He
    and Owen 2014, Optimal mixture weights in multiple importance sampling); the others are smooth or piecewise smooth
    in c, and a local minimum is what is found. Arguments as for `mis_variance`; `costs`: cost of one sample of each
    strategy; `minimum`: least fraction, < 1 / S.
    """
    size = log_p.shape[0]
    if not 0 <= minimum < 1 / size:
        raise InputError("minimum", minimum, f"a fraction in [0, 1 / {size})")
    cost = torch.ones(size, dtype=log_p.dtype) if costs is None else torch.as_tensor(costs, dtype=log_p.dtype)
    if cost.shape != (size,) or not bool(((cost > 0) & torch.isfinite(cost)).all()):
        raise InputError("costs", costs, f"{size} finite numbers > 0")
    cost, rule = cost.to(log_p.device), as_heuristic(heuristic)
    value, weight, log_p = nodes_value.detach(), nodes_weight.detach(), log_p.detach()
    floor = torch.finfo(log_p.dtype).eps
    best: list[Any] = [float("inf"), None, None]
    with torch.enable_grad():
        x = torch.zeros(size, dtype=log_p.dtype, device=log_p.device, requires_grad=True)
        optimiser = torch.optim.LBFGS([x], max_iter=steps, line_search_fn="strong_wolfe", tolerance_change=1e-10)

        def loss() -> Tensor:
            optimiser.zero_grad()
            fractions = minimum + (1 - size * minimum) * torch.softmax(x, dim=0)
            found = mis_variance(value, weight, log_p, fractions, rule, model=model)
            relative = (found.variance.sum(dim=-1) / found.m_star).mean()
            result = torch.log(relative.clamp_min(floor)) + torch.log((fractions * cost).sum())
            if float(result.detach()) < best[0]:
                best[:] = [float(result.detach()), fractions.detach(), float(found.variance_excess.detach().mean())]
            result.backward()
            return result

        optimiser.step(loss)
    return best[1], best[2]
