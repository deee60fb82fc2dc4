"""How good a proposal is at contexts that it was not trained on."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from dsfit.context import Context
from dsfit.errors import InputError
from dsfit.fit.amortise.targets import best_density
from dsfit.frame import cos_inclination, wrap
from dsfit.proposals.base import Proposal
from dsfit.quality import excess
from dsfit.scene.integrand import Integrand
from dsfit.scene.lights import ConstantLight

INCLINATIONS_DEG = (-89.0, -84.0, -78.0, -71.0, -61.0, -47.0, -33.0, -17.0, -4.0, 8.0, 22.0, 38.0, 53.0, 64.0, 73.0,
                    80.0, 86.0, 89.0)  # fmt: skip
DEPTHS = (0.5, 1.0, 2.0, 3.5, 6.0, 9.0, 13.0, 18.0, 24.0, 30.0)
_THETA_NODES, _AZIMUTH_NODES = 5, 9
_SHARES_SEED = 20_030_727


@dataclass(frozen=True)
class HeldOut:
    """Excess of a proposal at contexts `[N]`.

    Attributes:
        context: where.
        excess: M(p)/M* - 1 `[N]`; nan where no light is left in float64, such as a_f^n for n = 1e4.
        largest_weight: sup |F|/p over the nodes, in units of the mean `[N]`.
        checked: `[S, 2]`: excess by the quadrature used and by `dsfit.excess` at some of the contexts; the first of
            every `len(context) / S`.
    """

    context: Context
    excess: Tensor
    largest_weight: Tensor
    checked: Tensor

    def quantile(self, q: float) -> float:
        """Excess that a share q of the contexts stays below."""
        return float(torch.quantile(self.excess, q))

    @property
    def median(self) -> float:
        """Median of the excess."""
        return self.quantile(0.5)

    @property
    def p95(self) -> float:
        """95th percentile of the excess."""
        return self.quantile(0.95)

    @property
    def p99(self) -> float:
        """99th percentile of the excess."""
        return self.quantile(0.99)

    @property
    def worst(self) -> float:
        """Largest excess."""
        return float(self.excess.max())

    @property
    def where(self) -> dict[str, float]:
        """theta_r in degrees, n and v of the largest excess."""
        one = self.context[int(self.excess.argmax())]
        return {"theta_r_deg": math.degrees(float(one.theta_r)), "n": float(one.n), "v": float(one.v)}

    @property
    def disagreement(self) -> float:
        """Largest relative difference between the quadrature used and `dsfit.excess`, for an excess of at least 1e-3;
        nan where none was checked."""
        if not len(self.checked):
            return math.nan
        used, exact = self.checked.unbind(-1)
        return float(((used - exact).abs() / exact.clamp_min(1e-3)).max())

    def plain(self) -> dict[str, Any]:
        """The figures as plain data."""
        return {
            "contexts": len(self.context),
            "median": self.median,
            "p95": self.p95,
            "p99": self.p99,
            "worst": self.worst,
            "where": self.where,
            "largest_weight": float(self.largest_weight.max()),
            "checked": len(self.checked),
            "disagreement": self.disagreement,
        }


def held_out_contexts() -> Context:
    """The grid that `held_out` uses: 18 inclinations to +-89 degrees, each with n = 0 and v = 1, and ten n to 30 with v
    = 0 (a lit point or not), exp(-n) (Poisson) and a number drawn from (0, 1) with a fixed seed; 558 contexts."""
    theta = torch.tensor(INCLINATIONS_DEG, dtype=torch.float64) * (math.pi / 180)
    n = torch.tensor(DEPTHS, dtype=torch.float64)
    drawn = torch.rand(len(theta), len(n), generator=torch.Generator().manual_seed(_SHARES_SEED), dtype=torch.float64)
    depth = torch.cat([torch.zeros(1, dtype=torch.float64), n, n, n]).expand(len(theta), -1)
    fixed = torch.cat([torch.ones(1, dtype=torch.float64), torch.zeros_like(n), torch.exp(-n)])
    share = torch.cat([fixed.expand(len(theta), -1), drawn], dim=1)
    return Context(theta[:, None], 0.0, depth, share).reshape(-1)


@torch.no_grad()
def held_out(
    integrand: Integrand,
    proposal: Proposal,
    context: Context | None = None,
    *,
    check: int = 4,
    adaptive: bool = False,
    rtol: float = 1e-2,
) -> HeldOut:
    """Excess of a proposal at contexts, `held_out_contexts()` if none are given.

    In a white furnace around a round fibre, contexts that share theta_r share a tensor grid of some 6000 directions
    (panels that follow the lobes and the edges of N_p), so that hundreds take seconds; `check` of them are computed by
    `dsfit.excess` as well. Otherwise, or if `adaptive`, all are computed by `dsfit.excess` to `rtol`, which takes
    about a second for each. Float64.

    Raises:
        InputError: an integrand that is none, no context, or a negative number of checks.

    Example:
        >>> import dsfit
        >>> from dsfit.proposals import UniformSphere
        >>> furnace = dsfit.Integrand(dsfit.DualScattering(dsfit.Fiber.preset("blond"), precision="table"))
        >>> found = dsfit.held_out(furnace, UniformSphere(), dsfit.Context([0.0, 0.8], n=0.0), check=0)
        >>> [round(x, 1) for x in found.excess.tolist()]
        [5.7, 4.3]
    """
    if not isinstance(integrand, Integrand):
        raise InputError("integrand", type(integrand).__name__, "an Integrand")
    if isinstance(check, bool) or not isinstance(check, int) or check < 0:
        raise InputError("check", check, "an integer >= 0")
    context = held_out_contexts() if context is None else context.reshape(-1).to(torch.float64)
    if not len(context):
        raise InputError("context", context, "at least one context")
    if adaptive or not _is_white_furnace(integrand):
        found = excess(integrand, proposal, context, rtol)
        return HeldOut(context, found.value, found.largest_weight, torch.empty(0, 2, dtype=torch.float64))
    value, weight = torch.empty_like(context.theta_r), torch.empty_like(context.theta_r)
    for theta_r in context.theta_r.unique():
        here = torch.nonzero(context.theta_r == theta_r)[:, 0]
        value[here], weight[here] = _excess_on_grid(integrand, proposal, context[here])
    some = torch.arange(check) * len(context) // max(check, 1)
    exact = [excess(integrand, proposal, context[i], rtol).value for i in some]
    checked = torch.stack([value[some], torch.stack(exact)], dim=-1) if check else value.new_empty(0, 2)
    return HeldOut(context, value, weight, checked)


def _is_white_furnace(integrand: Integrand) -> bool:
    return integrand.is_even and isinstance(integrand.light, ConstantLight) and integrand.light.channels == 1


def _excess_on_grid(integrand: Integrand, proposal: Proposal, context: Context) -> tuple[Tensor, Tensor]:
    """Excess and largest weight `[M]` of contexts with one theta_r."""
    theta, phi, weight, target = best_density(integrand, context, _THETA_NODES, _AZIMUTH_NODES)
    theta_i = theta[:, None, None].expand(target.shape)
    phi_i = wrap(context.phi_r - phi[..., None])
    density = torch.exp(proposal(context).log_prob(torch.stack([theta_i, phi_i], dim=-1))) * cos_inclination(theta_i)
    ratio = torch.where(target > 0, target / density, 0.0)
    gap = torch.where(target > 0, (ratio - 1) * (target - density), density)
    seen = (weight > 0)[..., None]
    dark = target.isnan().any(0).any(0)  # no light is left in float64
    columns = (weight[..., None] * gap).sum((0, 1)), torch.where(seen, ratio, 0.0).amax((0, 1))
    return columns[0].masked_fill(dark, math.nan), columns[1].masked_fill(dark, math.nan)
