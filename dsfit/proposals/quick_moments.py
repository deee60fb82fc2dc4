"""The moments that an amortised proposal starts from, computed for all inclinations at once."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from dsfit.frame import HALF_PI, cos_inclination
from dsfit.proposals.lobe_moments import _FLOOR, _ROWS, _SIDE, LobeMoments
from dsfit.proposals.quick_tables import QuickScattering, interpolate
from dsfit.quadrature import gauss_legendre

_DEPTHS = (0.0, 0.25, 0.5, 1.0, 2.0, 3.0, 5.0, 8.0, 12.0, 18.0, 27.0, 40.0, 64.0)
_NODES, _LAST_NODES, _REACH = (24, 24), 14, 6.0
_GRAZING = 30  # rows at either end, a degree apart; between them every other row is computed
_AVERAGES = 257
_TINY = 1e-300
_LOBES = (0, 1, 2, 0, 3)
"""What the five scattered columns are made of: R at theta_i < 0, TT, TRT, R at theta_i > 0, back scattering."""
_SIDES = (-1.0, 0.0, 0.0, 1.0, 0.0)


class QuickMoments(LobeMoments):
    """`LobeMoments` of a fibre in about a tenth of the time, for depths up to 64; deeper, log energies go on linearly.

    For every inclination and depth at once, by Gauss quadrature over the part of the reachable theta_h that a lobe
    takes: first about its closed form, then about the mean and width that were found, and at last on either side of
    the mean.
    """

    def __init__(self, bsdf: QuickScattering) -> None:
        nn.Module.__init__(self)
        self.back = True
        with torch.no_grad():
            depths = torch.tensor(_DEPTHS, dtype=torch.float64)
            rows = [k for k in range(_ROWS) if k % 2 == 0 or min(k, _ROWS - 1 - k) < _GRAZING]
            theta_r = torch.linspace(-HALF_PI, HALF_PI, _ROWS, dtype=torch.float64)[rows]
            averages = _average_rows(bsdf)
            scattered = _filled(_moments(bsdf, averages, theta_r, depths, _SIDES), rows)
            direct = _moments(bsdf, averages, theta_r, depths[:1], (0.0,) * 5)[:, 0, :, [0, 1, 2, 4]]
            direct = _filled(direct, rows)
            direct[:, 0] -= torch.log(bsdf.d_f)
        self.register_buffer("direct", direct.contiguous())
        self.register_buffer("scattered", scattered.contiguous())
        self.register_buffer("depths", depths)


def _moments(
    bsdf: QuickScattering, averages: Tensor, theta_r: Tensor, depths: Tensor, sides: tuple[float, ...]
) -> Tensor:
    """Log energy, mean, log widths below and above, `[rows, depths, 4, 5]`."""
    fiber, grid = bsdf.fiber, (len(theta_r), len(depths))
    beta2, delta_b, sigma2 = (_column(averages, k, -theta_r, bsdf).mean(-1, keepdim=True) for k in (1, 3, 4))
    center = torch.cat([fiber.alpha.to(theta_r).expand(len(theta_r), 3), delta_b], dim=-1)[:, None]
    own = torch.cat([(fiber.beta.to(theta_r) ** 2).expand(len(theta_r), 3), sigma2], dim=-1)[:, None]
    width = torch.sqrt(own + depths[:, None] * beta2[:, None])
    center, width = (x.expand(*grid, 4)[..., list(_LOBES)] for x in (center, width))
    lowest = (theta_r / 2 - HALF_PI / 2)[:, None, None]
    highest = lowest + HALF_PI
    for nodes in _NODES:
        low, high = _reached(center, width, theta_r)
        theta_h, weight = _gauss(low, high, nodes)
        share = torch.softmax(_log_mass(bsdf, averages, theta_h, weight, theta_r, depths, sides), dim=-1)
        center = (share * theta_h).sum(-1)
        width = torch.sqrt((share * (theta_h - center[..., None]) ** 2).sum(-1)).clamp_min(1e-3)
    low, high = _reached(center, 1.3 * width, theta_r)
    center = torch.minimum(torch.maximum(center, low + 1e-6), high - 1e-6)
    halves = [_gauss(low, center, _LAST_NODES), _gauss(center, high, _LAST_NODES)]
    theta_h, weight = (torch.cat(x, dim=-1) for x in zip(*halves, strict=True))
    log_mass = _log_mass(bsdf, averages, theta_h, weight, theta_r, depths, sides)
    mean = (torch.softmax(log_mass, dim=-1) * theta_h).sum(-1)
    offset = theta_h - center[..., None]
    widths = []
    for part, x in zip(log_mass.chunk(2, dim=-1), offset.chunk(2, dim=-1), strict=True):
        square = (torch.softmax(part, dim=-1) * x**2).sum(-1)
        widths.append(0.5 * torch.log(square.clamp(1e-10, 4.0)))
    return torch.stack([torch.logsumexp(log_mass, dim=-1).clamp_min(_FLOOR), mean, *widths], dim=-2)


def _reached(center: Tensor, width: Tensor, theta_r: Tensor) -> tuple[Tensor, Tensor]:
    """The reachable theta_h about a lobe; where its centre is out of reach, the strip that is next to it."""
    lowest = (theta_r / 2 - HALF_PI / 2)[:, None, None]
    highest = lowest + HALF_PI
    low = torch.minimum(torch.maximum(center - _REACH * width, lowest), highest - 0.05)
    return low, torch.maximum(torch.minimum(center + _REACH * width, highest), low + 0.05)


def _gauss(low: Tensor, high: Tensor, nodes: int) -> tuple[Tensor, Tensor]:
    """Nodes and weights `[..., nodes]`."""
    x, w = gauss_legendre(nodes)
    half = ((high - low) / 2)[..., None]
    return low[..., None] + half * (1 + x), half * w


def _filled(computed: Tensor, rows: list[int]) -> Tensor:
    """All rows of a table of which some are computed: the others are means of their neighbours."""
    table = computed.new_zeros(_ROWS, *computed.shape[1:])
    table[rows] = computed
    missing = [k for k in range(_ROWS) if k not in rows]
    before, after = [k - 1 for k in missing], [k + 1 for k in missing]
    table[missing] = (table[before] + table[after]) / 2
    return table


def _log_mass(
    bsdf: QuickScattering,
    averages: Tensor,
    theta_h: Tensor,
    weight: Tensor,
    theta_r: Tensor,
    depths: Tensor,
    sides: tuple[float, ...],
) -> Tensor:
    """Log of every lobe's marginal times weight, in units of theta_i."""
    value = _log_marginals(bsdf, averages, theta_h, theta_r[:, None, None, None], depths, sides)
    return value + torch.log(2 * weight.clamp_min(_TINY))


def _log_marginals(
    bsdf: QuickScattering, averages: Tensor, theta_h: Tensor, theta_r: Tensor, depths: Tensor, sides: tuple[float, ...]
) -> Tensor:
    """Log of the norm over channels of every lobe's marginal at theta_h `[rows, depths, 5, nodes]`."""
    fiber = bsdf.fiber
    theta_i = (2 * theta_h - theta_r).clamp(-HALF_PI, HALF_PI)
    diff = theta_i - theta_h
    theta_in = bsdf._average_angle(theta_i, theta_r.expand_as(theta_i))
    n = depths[:, None, None, None]
    columns = interpolate(averages, _position(theta_in)).split(bsdf.channels, dim=-1)
    log_a, beta2, log_back, delta_b, sigma2 = columns
    passed, wide = torch.log(bsdf.d_f.clamp_min(_TINY)) + n * log_a, n * beta2
    parts = []
    for k, (p, side) in enumerate(zip(_LOBES, sides, strict=True)):
        here = (slice(None), slice(None), slice(k, k + 1))
        if p < 3:
            log_energy = torch.log(bsdf._mean_shares.energies(p, diff[here].abs()).clamp_min(_TINY))
            square, shift = fiber.beta[p] ** 2 + wide[here], (theta_h[here] - fiber.alpha[p]).unsqueeze(-1)
        else:
            around = 4.0 if bsdf.convention.back_azimuth == "all" else 2.0
            log_energy = torch.log(around * bsdf.d_b) + log_back[here]
            square, shift = sigma2[here] + wide[here], theta_h[here].unsqueeze(-1) - delta_b[here]
        value = log_energy + passed[here] - shift**2 / (2 * square) - torch.log(2 * math.pi * square) / 2
        if side:
            value = value + torch.nn.functional.logsigmoid(side * _SIDE * theta_i[here]).unsqueeze(-1)
        parts.append(value)
    norm = 0.5 * torch.logsumexp(2 * torch.cat(parts, dim=2), dim=-1)
    return norm + 2 * torch.log(cos_inclination(theta_i) / cos_inclination(diff))


def _position(theta_in: Tensor) -> Tensor:
    return (theta_in / math.pi + 0.5).clamp(0.0, 1.0) * (_AVERAGES - 1)


def _average_rows(bsdf: QuickScattering) -> Tensor:
    """log a_f, beta_f^2, log A_b, Delta_b and sigma_b^2 over theta_in, `[rows, 5 C]`."""
    found = bsdf.averages(torch.linspace(-HALF_PI, HALF_PI, _AVERAGES, dtype=torch.float64))
    log_a, log_back = (torch.log(x.clamp_min(_TINY)) for x in (found.a_f, found.A_b))
    return torch.cat([log_a, found.beta_f**2, log_back, found.delta_b, found.sigma_b**2], dim=-1)


def _column(averages: Tensor, k: int, theta_in: Tensor, bsdf: QuickScattering) -> Tensor:
    return interpolate(averages, _position(theta_in)).split(bsdf.channels, dim=-1)[k]


__all__ = ["QuickMoments"]
