"""Energies, means and widths of the integrand's lobes as tables over the viewing inclination and the number of fibres
that scatter: what an amortised proposal starts from."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from dsfit.bsdf.attenuation import lobe_energies
from dsfit.bsdf.azimuthal import refractions
from dsfit.bsdf.breaks import theta_breaks
from dsfit.bsdf.dual_scattering import DualScattering
from dsfit.bsdf.forward import event_count, log_transmittance
from dsfit.frame import HALF_PI, cos_inclination, theta_diff, theta_half
from dsfit.quadrature import panel_points
from dsfit.special import log_gauss

DIRECT = ("R", "TT", "TRT")
SCATTERED = ("R_scattered", "TT_scattered", "TRT_scattered", "R_scattered_low", "R_scattered_high")
"""R's scattered lobe is three: a_f^n of dark hair has its peaks at grazing light, on both sides."""

_DEPTHS = (0.0, 0.25, 0.5, 1.0, 1.5, 2.0, 3.0, 4.0, 6.0, 8.0, 11.0, 16.0, 22.0, 32.0, 45.0, 64.0, 128.0, 256.0, 1024.0,
           4096.0, 16384.0)  # fmt: skip
_ROWS, _POINTS = 181, 5
_SIDE, _STEEP = 0.7, 7.0
_GRAZING = [sign * x for x in (1.26, 1.32, 1.38, 1.42, 1.46, 1.49, 1.52, 1.54, 1.555) for sign in (-1.0, 1.0)]
"""Panel ends where a_f^n of dark hair has peaks a few hundredths of a radian wide, which wider panels miss: log widths
were wrong by up to 1.2, differently at every theta_r."""
_FLOOR = -1e5
_SKEW = 0.6


class LobeMoments(torch.nn.Module):
    """(log energy, mean and widths of theta_h) of every lobe's longitudinal marginal, norm over channels.

    For lobe p the marginal over azimuths is, up to a factor common to all,

        m(theta_i) = || E_p(theta_diff) M(theta_h) a_f(theta_i)^n || cos^2(theta_i) / cos^2(theta_diff),

    with M = g(theta_h - alpha_p; beta_p) and no a_f^n for direct light, and with variance beta_p^2 + n beta_f^2 for
    scattered light, or what the convention's transmittance has for a_f^n and n. Of each the table keeps log int m, the
    mean of theta_h, and log root mean squares below and above it. Bilinear in theta_r and n between rows; log energies
    go on linearly in n beyond the last.
    """

    direct: Tensor
    scattered: Tensor
    depths: Tensor

    def __init__(self, bsdf: DualScattering) -> None:
        super().__init__()
        self.back = bool(bsdf.d_b > 0)
        with torch.no_grad():
            rows = [_row(bsdf, x, self.back) for x in torch.linspace(-HALF_PI, HALF_PI, _ROWS, dtype=torch.float64)]
        self.register_buffer("direct", torch.stack([near for near, _ in rows]))
        self.register_buffer("scattered", torch.stack([far for _, far in rows]))
        self.register_buffer("depths", torch.tensor(_DEPTHS, dtype=torch.float64))

    def forward(self, theta_r: Tensor, n: Tensor) -> tuple[Tensor, Tensor]:
        """Moments of direct light `[*batch, 4, 3 (+ 1)]` and of scattered light `[*batch, 4, 5 (+ 1)]`; the last column
        is back scattering, if d_b > 0."""
        position = (theta_r / math.pi + 0.5).clamp(0.0, 1.0) * (_ROWS - 1)
        row = position.detach().to(torch.int64).clamp(0, _ROWS - 2)
        across = (position - row).reshape(-1, 1, 1)
        row = row.reshape(-1)
        direct = self.direct.to(theta_r)
        near = torch.lerp(direct[row], direct[row + 1], across)
        depths = self.depths.to(theta_r)
        level = (torch.searchsorted(depths, n.detach().contiguous(), right=True) - 1).clamp(0, len(depths) - 2)
        low, high = depths[level], depths[level + 1]
        along = ((n - low) / (high - low)).reshape(-1, 1, 1)
        level = level.reshape(-1)
        table = self.scattered.to(theta_r)
        before = torch.lerp(table[row, level], table[row + 1, level], across)
        after = torch.lerp(table[row, level + 1], table[row + 1, level + 1], across)
        inside = torch.lerp(before, after, along.clamp_max(1.0))
        energy = torch.lerp(before[:, :1], after[:, :1], along)
        far = torch.cat([energy, inside[:, 1:]], dim=1)
        return near.reshape(*theta_r.shape, 4, -1), far.reshape(*theta_r.shape, 4, -1)


def _row(bsdf: DualScattering, theta_r: Tensor, back: bool) -> tuple[Tensor, Tensor]:
    """Moments at one viewing inclination: direct `[4, 3 (+ 1)]`, scattered `[depths, 4, 5 (+ 1)]`."""
    fiber = bsdf.fiber
    theta_i, weight = panel_points(theta_breaks(bsdf, theta_r, _GRAZING), _POINTS)
    theta_h, diff = theta_half(theta_i, theta_r), theta_diff(theta_i, theta_r)
    average = bsdf.averages(theta_i)
    bent = refractions(fiber, diff, torch.full_like(diff, math.pi / 4))
    energies = _log(lobe_energies(bent, fiber.sigma_a, bsdf.convention.absorption)).unbind(-2)
    around = 4.0 if bsdf.convention.back_azimuth == "all" else 2.0
    behind = _log(around * bsdf.d_b * average.A_b)
    measure = _log(weight * cos_inclination(theta_i) ** 2 / cos_inclination(diff) ** 2)
    n = torch.tensor(_DEPTHS, dtype=torch.float64)[:, None, None]
    law = bsdf.convention.transmittance
    passed = _log(bsdf.d_f) + log_transmittance(_log(average.a_f), n, law)
    wide = event_count(average.a_f, n, law) * average.beta_f**2
    shift, beta = theta_h[:, None] - fiber.alpha, fiber.beta.expand(len(theta_i), 3)
    near = [e + log_gauss(shift[:, k], beta[:, k])[:, None] for k, e in enumerate(energies)]
    far = [
        passed + e + log_gauss(shift[:, k, None], torch.sqrt(beta[:, k, None] ** 2 + wide))
        for k, e in enumerate(energies)
    ]
    far = [far[0] + _part(theta_i, 0), *far[1:], far[0] + _part(theta_i, -1), far[0] + _part(theta_i, 1)]
    if back:
        offset = theta_h[:, None] - average.delta_b
        near.append(behind + log_gauss(offset, average.sigma_b))
        far.append(passed + behind + log_gauss(offset, torch.sqrt(average.sigma_b**2 + wide)))
    tables = [torch.stack([_moments(part, measure, theta_h) for part in parts], dim=-1) for parts in (near, far)]
    return tables[0], tables[1]


def _part(theta_i: Tensor, side: int) -> Tensor:
    """log of a smooth partition of unity, `[J, 1]`: grazing light from below, from above, and the rest."""
    low, high = torch.sigmoid(-_STEEP * (theta_i + _SIDE)), torch.sigmoid(_STEEP * (theta_i - _SIDE))
    return _log((low, 1 - low - high, high)[side + 1]).unsqueeze(-1)


def _moments(log_part: Tensor, log_measure: Tensor, theta_h: Tensor) -> Tensor:
    """log energy, and mode and log widths of the split normal law with the marginal's mean, variance and skewness
    (as far as such a law can have it), `[..., 4]`, of a marginal `[..., J, C]`.

    With d = s_+ - s_- the split normal law has mean - mode = sqrt(2/pi) d, variance s_- s_+ + (1 - 2/pi) d^2 and third
    central moment sqrt(2/pi) d (s_- s_+ + (4/pi - 1) d^2); solved for d by two fixed-point steps.
    """
    log_mass = 0.5 * torch.logsumexp(2 * log_part, dim=-1) + log_measure
    share = torch.softmax(log_mass, dim=-1)
    mean = (share * theta_h).sum(-1, keepdim=True)
    variance = (share * (theta_h - mean) ** 2).sum(-1).clamp(1e-10, 4.0)
    third = (share * (theta_h - mean) ** 3).sum(-1)
    root = math.sqrt(2 / math.pi)
    limit = _SKEW * torch.sqrt(variance / (1 - 2 / math.pi))
    d = torch.zeros_like(variance)
    for _ in range(4):
        d = third / (root * (variance - (2 - 6 / math.pi) * d**2))
        d = torch.minimum(torch.maximum(d, -limit), limit)
    product = variance - (1 - 2 / math.pi) * d**2
    center = torch.sqrt(product + d**2 / 4)
    energy = torch.logsumexp(log_mass, dim=-1).clamp_min(_FLOOR)
    return torch.stack([energy, mean[..., 0] - root * d, torch.log(center - d / 2), torch.log(center + d / 2)], dim=-1)


def _log(x: Tensor) -> Tensor:
    return torch.log(x.clamp_min(1e-300))
