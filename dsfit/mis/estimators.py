"""The multi-sample and the one-sample estimator as differentiable functions of given uniforms.

Both use one number per drawn direction, its contribution `z = w_s F / (c_s p_s)`, where c_s = n_s / N (multi-sample) or
the probability of choosing s (one-sample): the estimate is `sum_s c_s mean_s z` or `mean z`. For the balance heuristic
z = F / sum_k c_k p_k.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

from dsfit.context import Context
from dsfit.errors import InputError
from dsfit.mis.heuristics import Balance, Heuristic, Optimal, log_effective
from dsfit.mis.heuristics import heuristic as as_heuristic
from dsfit.proposals.base import Distribution

IntegrandFunction = Callable[[Tensor, Context], Tensor]
"""integrand(omega `[..., 2]`, context) -> `[..., C]`."""


def draw(distributions: Sequence[Distribution], strategy: int, u: Tensor) -> tuple[Tensor, Tensor]:
    """Directions `[..., 2]` of one strategy and the log densities `[S, ...]` of all strategies there."""
    omega, own = distributions[strategy].sample_with_log_prob(u)
    logs = [own if k == strategy else other.log_prob(omega) for k, other in enumerate(distributions)]
    return omega, torch.stack(torch.broadcast_tensors(*logs))


def draw_mixture(
    distributions: Sequence[Distribution], probabilities: Tensor, u: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Directions of a randomly chosen strategy, log densities `[S, ...]` there, and the choice `[...]`.

    The first of the `1 + max dimension` uniforms chooses. Every strategy draws and the choice selects, which keeps
    batches of contexts rectangular; the integrand is still evaluated once per sample.
    """
    bounds = torch.cumsum(probabilities, 0)
    used = torch.nonzero(probabilities > 0).flatten().tolist()
    choice = torch.searchsorted(bounds, u[..., 0].contiguous(), right=True).clamp_max(used[-1])
    omega = None
    for s in used:
        drawn = distributions[s].sample(u[..., 1 : 1 + distributions[s].dimension])
        omega = drawn if omega is None else torch.where((choice == s).unsqueeze(-1), drawn, omega)
    logs = [distribution.log_prob(omega) for distribution in distributions]
    return omega, torch.stack(torch.broadcast_tensors(*logs)), choice


def evaluate(integrand: IntegrandFunction, omega: Tensor, context: Context, source: str = "the proposals") -> Tensor:
    """Integrand values `[..., C]`, checked for shape and finiteness; `source` is who drew the directions."""
    value = integrand(omega, context)
    try:
        value = value.expand(*omega.shape[:-1], value.shape[-1])
    except RuntimeError:
        raise InputError("integrand", tuple(value.shape), f"values of shape {tuple(omega.shape[:-1])} + (C,)") from None
    bad = ~torch.isfinite(value.detach())
    if bool(bad.any()):
        where = tuple(omega.detach()[bad.any(dim=-1)][0].tolist())
        if not all(math.isfinite(x) for x in where):
            raise InputError(f"direction drawn by {source}", where, "finite angles")
        raise InputError(f"integrand at (theta_i, phi_i) = {where}", value.detach()[bad][0].item(), "finite values")
    return value


def contribution(
    value: Tensor,
    log_p: Tensor,
    own: int | Tensor,
    fractions: Tensor,
    rule: Heuristic,
    names: Sequence[str] | None = None,
) -> Tensor:
    """z = w_s F / (c_s p_s) `[..., C]`, computed in logs; balance form F / P for the optimal heuristic.

    Args:
        value: F `[..., C]`.
        log_p: log densities `[S, ...]`.
        own: index of the strategy that drew the directions, or a tensor `[...]` of them.
        fractions: c_s `[S]`.
        rule: the heuristic.
        names: of the strategies, for the message.

    Raises:
        InputError: a contribution is not finite; names the strategy. A density of 0 where F = 0 is fine and contributes
            0.
    """
    log_weights = (Balance() if isinstance(rule, Optimal) else rule).log_weights(log_p, fractions)
    log_ratio = _pick(log_weights - log_effective(log_p, fractions), own)
    # an own density of 0 (-inf - -inf above) is harmless where the integrand is 0 as well
    harmless = (value.detach() == 0).all(dim=-1) & ~torch.isfinite(log_ratio.detach())
    half = torch.exp(0.5 * torch.where(harmless, 0.0, log_ratio)).unsqueeze(-1)
    z = (value * half) * half  # in two steps: 1/p may overflow where F / p does not
    bad = ~torch.isfinite(z.detach()).all(dim=-1) | ~(log_p.detach() < torch.inf).all(dim=0)
    if bool(bad.any()):
        _raise_bad_weight(value.detach()[bad][0], log_p.detach()[:, bad][:, 0], z.detach()[bad][0], own, bad, names)
    return z


def _raise_bad_weight(
    value: Tensor, log_p: Tensor, z: Tensor, own: int | Tensor, bad: Tensor, names: Sequence[str] | None
) -> None:
    drawn_by = own if isinstance(own, int) else int(own.expand(bad.shape)[bad][0])
    broken = torch.nonzero(~(log_p < torch.inf)).flatten().tolist()
    strategy = broken[0] if broken else drawn_by
    label = f"proposals[{strategy}]" + (f" ({names[strategy]})" if names else "")
    raise InputError(
        f"{label}: log density {log_p[strategy].item():g} at a sample of proposals[{drawn_by}] with integrand "
        f"{value.tolist()} and weight F w / p",
        z.tolist(),
        "finite weights: log densities < inf, and > -inf where the own sampler goes and the integrand is not 0",
    )


def _pick(stacked: Tensor, own: int | Tensor) -> Tensor:
    if isinstance(own, int):
        return stacked[own]
    return stacked.gather(0, own.expand(stacked.shape[1:]).unsqueeze(0)).squeeze(0)


def control_variates(log_p: Tensor, fractions: Tensor) -> Tensor:
    """r_k = p_k / P `[..., S]` with P = sum_k c_k p_k, in [0, 1 / c_k]; 0 where c_k = 0 or every density is 0."""
    used = fractions > 0
    inverse = torch.where(used, 1 / torch.where(used, fractions, 1.0), 0.0)
    return Balance().weights(log_p, fractions).movedim(0, -1) * inverse


def multi_sample(
    integrand: IntegrandFunction,
    distributions: Sequence[Distribution],
    context: Context,
    uniforms: Sequence[Tensor],
    heuristic: Any = "balance",
    alpha: Tensor | None = None,
) -> Tensor:
    """Multi-sample estimate `[*batch, C]` from uniforms `[n_s, *batch, dimension_s]` for each strategy.

    `sum_s 1/n_s sum_i w_s F / p_s` (chapter eq 2; Veach 1997, section 9.2.1). Differentiable in the integrand's, the
    context's and, through the reparametrised samples and densities, the proposals' parameters. `alpha [*batch, S, C]`
    is needed by the optimal heuristic and must not come from the same uniforms.
    """
    rule = _rule(heuristic, alpha)
    if len(uniforms) != len(distributions) or not all(isinstance(u, Tensor) and u.ndim for u in uniforms):
        shapes = [tuple(getattr(u, "shape", ())) for u in uniforms]
        raise InputError("uniforms", shapes, f"shapes [n, *batch, dimension], one for each of {len(distributions)}")
    total = sum(u.shape[0] for u in uniforms)
    if not total:
        raise InputError("uniforms", total, "at least one sample")
    fractions = torch.tensor([u.shape[0] / total for u in uniforms], dtype=context.dtype, device=context.device)
    result: Tensor | None = None
    for s, u in enumerate(uniforms):
        if u.shape[0] == 0:
            continue
        omega, log_p = draw(distributions, s, u)
        z = contribution(evaluate(integrand, omega, context), log_p, s, fractions, rule)
        mean = fractions[s] * _less_control(z, log_p, fractions, alpha).mean(dim=0)
        result = mean if result is None else result + mean
    return result if alpha is None else result + alpha.sum(dim=-2)


def one_sample(
    integrand: IntegrandFunction,
    distributions: Sequence[Distribution],
    context: Context,
    uniforms: Tensor,
    probabilities: Tensor,
    heuristic: Any = "balance",
    alpha: Tensor | None = None,
) -> Tensor:
    """One-sample estimate `[*batch, C]`: mean of w_s F / (c_s p_s), each s chosen with probability c_s.

    Veach 1997, section 9.2.4. `uniforms [n, *batch, 1 + max dimension]`; the first of them chooses. Otherwise as
    `multi_sample`.
    """
    rule = _rule(heuristic, alpha)
    omega, log_p, choice = draw_mixture(distributions, probabilities, uniforms)
    z = contribution(evaluate(integrand, omega, context), log_p, choice, probabilities, rule)
    result = _less_control(z, log_p, probabilities, alpha).mean(dim=0)
    return result if alpha is None else result + alpha.sum(dim=-2)


def _rule(kind: Any, alpha: Tensor | None) -> Heuristic:
    rule = as_heuristic(kind)
    if isinstance(rule, Optimal) != (alpha is not None):
        raise InputError("alpha", alpha, "a tensor [*batch, S, C] with the optimal heuristic, None with any other")
    return rule


def _less_control(z: Tensor, log_p: Tensor, fractions: Tensor, alpha: Tensor | None) -> Tensor:
    if alpha is None:
        return z
    return z - torch.einsum("...s,...sc->...c", control_variates(log_p, fractions), alpha)
