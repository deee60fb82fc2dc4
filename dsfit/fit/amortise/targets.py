"""What an amortised proposal is trained on: the best density of many contexts, on tensor grids of directions."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import Any

import torch
from torch import Tensor

from dsfit.bsdf.averages import Averages
from dsfit.bsdf.dual_scattering import DualScattering
from dsfit.context import Context
from dsfit.cubature import Cells, nodes_of
from dsfit.frame import HALF_PI, cos_inclination, theta_diff
from dsfit.proposals.amortised import AmortisedProposal
from dsfit.quadrature import merge_breaks, panel_points
from dsfit.scene.integrand import Integrand

THETA_NODES, AZIMUTH_NODES = 3, 6
_DARK = 1e-280  # below, some directions have underflown
_GRAZING = (1.3, 1.4, 1.48, 1.53)


@dataclass(frozen=True)
class Targets:
    """R viewing inclinations, each with M pairs (n, v), on J x L directions of the half circle phi >= 0.

    Attributes:
        context: the contexts, `[R, M]`.
        theta: theta_i of the nodes, `[R, J]`.
        weight: of the nodes, both half circles together, `[R, J, L]`: sum w g ~ int g dtheta_i dphi.
        target: |F| cos(theta_i) / int |F| domega, `[R, J, L, M]`: the best density, per radian of theta_i and phi.
        azimuth: densities of the proposal's azimuthal laws per radian, `[R, J, L, K]`.
    """

    context: Context
    theta: Tensor
    weight: Tensor
    target: Tensor
    azimuth: Tensor

    def __len__(self) -> int:
        return len(self.theta)

    def __getitem__(self, rows: Tensor | slice) -> Targets:
        parts = (self.theta[rows], self.weight[rows], self.target[rows], self.azimuth[rows])
        return Targets(self.context[rows], *parts)


class _Tabulated(DualScattering):
    """The same BSDF at fixed directions, where azimuths and averages are known."""

    def __init__(self, bsdf: DualScattering, direct: Tensor, scattered: Tensor, average: Averages) -> None:
        vars(self).update(vars(bsdf))
        self._known = direct, scattered, average

    def azimuthal(self, *_: Any, **__: Any) -> Tensor:
        return self._known[0]

    def azimuthal_scattered(self, *_: Any, **__: Any) -> Tensor:
        return self._known[1]

    def averages(self, *_: Any, **__: Any) -> Averages:
        return self._known[2]


@torch.no_grad()
def make_targets(
    bsdf: DualScattering,
    proposal: AmortisedProposal,
    context: Context,
    *,
    dtype: torch.dtype = torch.float32,
    theta_nodes: int = THETA_NODES,
    azimuth_nodes: int = AZIMUTH_NODES,
) -> Targets:
    """Grids for contexts `[R, M]` whose theta_r is the same along M.

    theta_i has Gauss panels between the lobes' centres and flanks (`dsfit.bsdf.breaks`), phi panels between the edges
    of N_p, with nodes gathered at both ends. All that depends on theta_r alone (azimuths, averages, laws) is computed
    once for M contexts. Computed in float64, as a_f^n falls below float32, and stored in `dtype`.
    """
    context = context.to(torch.float64)
    integrand = Integrand(bsdf)
    rows = [_row(integrand, proposal, context[i], dtype, theta_nodes, azimuth_nodes) for i in range(len(context))]
    longest = max(len(row[0]) for row in rows)
    columns = zip(*rows, strict=True)
    return Targets(context.to(dtype), *(torch.stack([_padded(x, longest) for x in part]) for part in columns))


def _padded(x: Tensor, length: int) -> Tensor:
    """More nodes of weight 0: copies of the last for theta_i and the laws (so that nothing overflows), else zeros."""
    missing = length - len(x)
    return torch.cat([x, x[-1:].expand(missing, *x.shape[1:]) * (0.0 if x.dim() == 2 else 1.0)])


def _row(
    integrand: Integrand,
    proposal: AmortisedProposal,
    context: Context,
    dtype: torch.dtype,
    theta_nodes: int,
    azimuth_nodes: int,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """theta `[J]`, weight `[J, L]`, target `[J, L, M]`, laws `[J, L, K]` of one viewing inclination."""
    theta, phi, weight, target = best_density(integrand, context, theta_nodes, azimuth_nodes)
    laws = [torch.exp(law(context[0]).log_prob(phi, theta[:, None])) for law in proposal.laws]
    return theta.to(dtype), weight.to(dtype), target.to(dtype), torch.stack(laws, dim=-1).to(dtype)


@torch.no_grad()
def best_density(
    integrand: Integrand, context: Context, theta_nodes: int, azimuth_nodes: int
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Nodes of contexts `[M]` with one theta_r: theta_i `[J]`, phi and weights `[J, L]`, and p* cos(theta_i)
    `[J, L, M]` there, in float64; see `Targets`. nan where float64 knows no light."""
    both = Context(context.theta_r[0], 0.0, 1.0, 0.5)  # edges of direct and of scattered azimuths
    theta, theta_weight = panel_points(_breaks(integrand, both), theta_nodes)
    phi, weight = _azimuths(integrand, both, theta, azimuth_nodes)
    weight = 2 * theta_weight[:, None] * weight
    value = _values(integrand.bsdf, context, theta, phi)
    target = torch.linalg.vector_norm(value, dim=-1) * cos_inclination(theta)[:, None, None]
    norm = (weight[..., None] * target).sum((0, 1))
    return theta, phi, weight, target / norm.masked_fill(norm < _DARK, math.nan)


def _breaks(integrand: Integrand, context: Context) -> Tensor:
    """Panel ends in theta_i: those of the integrand, thinned where they are closer than a lobe asks for, and some next
    to grazing, where a_f^n of dark hair has its peaks."""
    narrow = 0.3 * float(integrand.bsdf.fiber.beta.detach().min())
    grazing = torch.tensor([sign * x for x in _GRAZING for sign in (-1, 1)], dtype=torch.float64)
    found = torch.cat([integrand.theta_breaks(context), grazing])
    return merge_breaks(found, -HALF_PI, HALF_PI, min(narrow, 0.02))


def _azimuths(integrand: Integrand, context: Context, theta: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """phi >= 0 and weights `[J, L]` on panels between the edges at each theta_i."""

    def edges(at: Tensor) -> Tensor:
        found = integrand.azimuth_edges(context, at, coarse=True)
        return found.clamp_min(0.0)[..., found.shape[-1] // 2 :]

    bounds = edges(theta)
    segments = bounds.shape[-1] - 1
    unit = torch.tensor([0.0, 1.0], dtype=theta.dtype)
    s = nodes_of(Cells.grid(unit, 1), lambda at: unit.expand(*at.shape, 2), count)
    graded, slope = s[1][0, 0], s[2][0].sum(0)
    width = bounds.diff(dim=-1)
    phi = bounds[:, :segments, None] + width[..., None] * graded
    return phi.flatten(1), (width[..., None] * slope).flatten(1)


def _values(bsdf: DualScattering, context: Context, theta: Tensor, phi: Tensor) -> Tensor:
    """F cos(theta_i), `[J, L, M, C]`: azimuths once, lobes and attenuation for every (n, v)."""
    theta_r, n, v = context.theta_r[0], context.n, context.v
    diff = theta_diff(theta, theta_r)[:, None]
    average = bsdf.averages(bsdf._average_angle(theta, theta_r))
    average = Averages(*(getattr(average, f.name)[:, None, None] for f in fields(Averages)))
    direct, scattered = (f(diff, phi)[:, :, None] for f in (bsdf.azimuthal, bsdf.azimuthal_scattered))
    known = _Tabulated(bsdf, direct, scattered, average)
    theta_i, phi = theta[:, None, None], phi[..., None]
    lit, unlit = (1.0, 1.0) if bsdf.convention.share == "sum" else (v[:, None], (1 - v)[:, None])
    value = lit * known.direct(theta_i, theta_r, phi, n) + unlit * known.scatter(theta_i, theta_r, phi, n)
    return value * cos_inclination(theta_i).unsqueeze(-1)
