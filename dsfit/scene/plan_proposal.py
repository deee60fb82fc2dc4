"""Components of a mixture that do not pay for their cost are left out of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from dsfit.context import Context
from dsfit.errors import InputError, as_number, as_real, check_range
from dsfit.proposals.base import Proposal
from dsfit.proposals.mixture import MixtureDistribution
from dsfit.quality import excess, quadrature_nodes
from dsfit.scene.integrand import Integrand


class PrunedProposal(Proposal):
    """Some components of a mixture with their weights normalised again: p' = sum_{k kept} w_k p_k / sum_{k kept} w_k.

    Args:
        whole: a proposal whose distributions are mixtures (`Mixture`, `StructuredProposal`, `AmortisedProposal`).
        keep: numbers of the components that stay, the defensive one among them if there is one (it is the last).
    """

    def __init__(self, whole: Proposal, keep: Sequence[int]) -> None:
        super().__init__()
        self.whole, self.keep = whole, tuple(keep)

    def forward(self, context: Context) -> MixtureDistribution:
        found = mixture_of(self.whole, context)
        weights = found.log_weights[..., list(self.keep)]
        weights = weights - torch.logsumexp(weights, dim=-1, keepdim=True)
        return MixtureDistribution([found.components[k] for k in self.keep], weights)


@dataclass(frozen=True)
class Pruned:
    """A smaller mixture, and what that does to variance.

    Attributes:
        proposal: the mixture of what is left.
        dropped: number, name and largest share over the contexts of every component that went.
        excess, excess_error: of the smaller mixture, by quadrature with its error bound, `[*batch]`; `excess_before` of
            the whole one.
        gain: expected ratio of time x variance before and after, the mean over contexts of their logarithms.
    """

    proposal: PrunedProposal
    dropped: tuple[tuple[int, str, float], ...]
    excess_before: Tensor
    excess: Tensor
    excess_error: Tensor
    gain: float


def mixture_of(proposal: Proposal, context: Context) -> MixtureDistribution:
    """The proposal's distribution; `InputError` if it is no mixture."""
    found = proposal(context) if callable(proposal) else None
    if not isinstance(found, MixtureDistribution):
        raise InputError("proposal", type(proposal).__name__, "a proposal whose distributions are mixtures")
    return found


def prune(
    proposal: Proposal,
    integrand: Integrand,
    context: Context,
    *,
    costs: Sequence[float] | None = None,
    base: float = 8.0,
) -> Pruned:
    """Leave out the components whose cost is more than they save in variance, over all the contexts given.

    With p = (1 - w) p' + w p_k, p >= (1 - w) p' everywhere, so that M(p') >= (1 - w) M(p): leaving out a share w lowers
    the second moment by at most that factor. How far it may rise has no bound but where other components cover p_k, so
    it is computed: M(p_S) for every S tried on quadrature nodes, and the excess of the result by quadrature with an
    error bound. Components go one after the other, first the one that lowers time x variance most, until none does;
    time is `base` plus the `costs` of the components left. The defensive component always stays: it bounds the weights.

    Args:
        proposal: a mixture.
        integrand: what is sampled, planned or not.
        context: contexts that matter.
        costs: of one density evaluation of each component, in any unit; equal if left out.
        base: cost of a sample besides, in the same unit; drawing and weighing a sample was measured to cost as much as
            8 components, on one core in float64, without the integrand.

    Raises:
        InputError: no mixture, another number of costs than components, costs that are not positive.
    """
    context = context.to(torch.float64).reshape(-1)
    with torch.no_grad():
        whole = mixture_of(proposal, context)
        count = len(whole.components)
        price = torch.ones(count, dtype=torch.float64) if costs is None else as_real("costs", costs, torch.float64)
        if price.shape != (count,):
            raise InputError("costs", tuple(price.shape), f"one number for each of {count} components")
        price = check_range("costs", price, 0.0, open_low=True)
        base = as_number("base", base, 0.0)
        names = _names(proposal, count)
        keep = list(range(count))
        tables = [_table(proposal, integrand, context[i]) for i in range(len(context))]
        best = _score(tables, keep, price, base)
        start = best
        while len(keep) > 1:
            free = [k for k in keep if names[k] != "defensive"]
            tried = {k: _score(tables, [j for j in keep if j != k], price, base) for k in free}
            worst = min(tried, key=lambda k: tried[k])
            if not tried[worst] < best:
                break
            keep, best = [j for j in keep if j != worst], tried[worst]
        weights = torch.exp(whole.log_weights).expand(len(context), count)
        dropped = tuple((k, names[k], float(weights[:, k].max())) for k in range(count) if k not in keep)
        smaller = PrunedProposal(proposal, keep)
        before, after = (excess(integrand, x, context, 1e-2) for x in (proposal, smaller))
    return Pruned(smaller, dropped, before.value, after.value, after.error, float(torch.exp(start - best)))


def _names(proposal: Proposal, count: int) -> list[str]:
    """Names of the components, or their numbers; the defensive one is the last."""
    last = ["defensive"] if getattr(proposal, "defensive", 0.0) > 0 else []
    own = list(getattr(proposal, "names", ()))
    return [*(own if len(own) == count - len(last) else map(str, range(count - len(last)))), *last]


@dataclass(frozen=True)
class _Table:
    """Of one context: weighted squares w |f|^2 at its nodes `[Q]`, densities times shares `[Q, K]`, shares `[K]`, and
    |int f|^2."""

    square: Tensor
    density: Tensor
    shares: Tensor
    least: Tensor


def _table(proposal: Proposal, integrand: Integrand, context: Context) -> _Table:
    nodes = quadrature_nodes(integrand, context, rtol=1e-3)
    found = mixture_of(proposal, context)
    density = torch.exp(found.component_log_probs(nodes.omega) + found.log_weights)
    value = (nodes.weight[:, None] * nodes.value).sum(0)
    return _Table(nodes.weight * nodes.norm**2, density, torch.exp(found.log_weights), (value**2).sum())


def _score(tables: list[_Table], keep: list[int], price: Tensor, base: float) -> Tensor:
    """Mean logarithm of time x variance; inf where f is not covered."""
    logs = []
    for table in tables:
        density = table.density[:, keep].sum(-1) / table.shares[keep].sum()
        moment = torch.where(table.square > 0, table.square / density, 0.0).sum()
        logs.append(torch.log((moment - table.least).clamp_min(1e-300)))
    return torch.stack(logs).mean() + torch.log(base + price[keep].sum())
