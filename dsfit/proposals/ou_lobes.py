"""Shares, centres and widths of the integrand's lobes at a context, in closed form: what mixtures without a fit use."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from dsfit.bsdf.attenuation import lobe_energies
from dsfit.bsdf.azimuthal import refractions
from dsfit.bsdf.dual_scattering import DualScattering
from dsfit.bsdf.forward import event_count, log_transmittance
from dsfit.context import Context
from dsfit.errors import InputError
from dsfit.frame import HALF_PI, cos_inclination
from dsfit.special import log_share

FAMILIES = ("R", "TT", "TRT", "R_scattered", "TT_scattered", "TRT_scattered", "back")
_TINY = 1e-30
_ROWS = 257


class SpecularTable(nn.Module):
    """What the lobes are at the specular guess theta_i = 2 alpha_p - theta_r (averages at -theta_r), from a table over
    theta_r, linear between rows: log energies of R, TT, TRT and of back scattering, log a_f, beta_f^2, Delta_b,
    sigma_b^2, each `[*batch, C]`."""

    table: Tensor

    def __init__(self, bsdf: DualScattering) -> None:
        super().__init__()
        with torch.no_grad():
            theta_r = torch.linspace(-HALF_PI, HALF_PI, _ROWS, dtype=torch.float64)
            average, fiber = bsdf.averages(-theta_r), bsdf.fiber
            theta_i = (2 * fiber.alpha.to(torch.float64) - theta_r[:, None]).clamp(-HALF_PI, HALF_PI)
            diff = (theta_r[:, None] - theta_i) / 2
            bent = refractions(fiber, diff, torch.full_like(diff, math.pi / 4))
            energies = lobe_energies(bent, fiber.sigma_a.to(torch.float64), bsdf.convention.absorption)
            own = torch.stack([energies[:, p, p, :] for p in range(3)], dim=1)
            seen = (cos_inclination(theta_i) / cos_inclination(diff)) ** 2
            lobes = torch.log(own * seen.clamp_min(1e-6)[..., None] + _TINY)
            around = 4.0 if bsdf.convention.back_azimuth == "all" else 2.0
            back = torch.log(around * bsdf.d_b.to(torch.float64) * average.A_b + _TINY)
            passed = torch.log(average.a_f.clamp_min(_TINY))
            rows = [*lobes.unbind(1), back, passed, average.beta_f**2, average.delta_b, average.sigma_b**2]
        self.channels = bsdf.channels
        self.register_buffer("table", torch.cat(rows, dim=-1).contiguous())

    def forward(self, theta_r: Tensor) -> tuple[Tensor, ...]:
        position = (theta_r / math.pi + 0.5).clamp(0.0, 1.0) * (_ROWS - 1)
        row = position.detach().to(torch.int64).clamp(0, _ROWS - 2).reshape(-1)
        table = self.table.to(theta_r)
        value = torch.lerp(table[row], table[row + 1], (position.reshape(-1) - row).unsqueeze(-1))
        return value.reshape(*theta_r.shape, -1).split(self.channels, dim=-1)


class ContextLobes(nn.Module):
    """`lobes(context)`: log shares, centres and widths in theta_h of `FAMILIES`, each `[*batch, 7]`.

    Shares are energies at the specular guess theta_i = 2 alpha_p - theta_r, norms over channels: v E_p of the direct
    lobes, (1 - v) d_f a_f^n E_p of the scattered ones, and of back scattering those of both, (v + (1 - v) d_f a_f^n)
    E_b. Widths are beta_p, sqrt(beta_p^2 + n beta_f^2), and sqrt(sigma_b^2 + s n beta_f^2) with s the share of
    scattered light in back scattering; a_f^n and n as the convention's transmittance has them. Nothing is fitted.

    Raises:
        InputError: a batch of fibres.
    """

    alpha: Tensor
    variance: Tensor

    def __init__(self, bsdf: DualScattering) -> None:
        super().__init__()
        if bsdf.fiber.batch_shape:
            raise InputError("bsdf.fiber", tuple(bsdf.fiber.batch_shape), "a single fibre")
        self.table = SpecularTable(bsdf)
        self.back, self.law = bool(bsdf.d_b > 0), bsdf.convention.transmittance
        self.log_density = math.log(max(float(bsdf.d_f), _TINY))
        self.register_buffer("alpha", bsdf.fiber.alpha.detach().to(torch.float64))
        self.register_buffer("variance", bsdf.fiber.beta.detach().to(torch.float64) ** 2)

    def forward(self, context: Context) -> tuple[Tensor, Tensor, Tensor]:
        """log shares (their exponentials sum to 1), centres and widths, `[*batch, 7]`."""
        theta_r, n, v = context.theta_r, context.n, context.v
        with torch.no_grad():
            *own, back, passed, beta2, delta_b, sigma2 = self.table(theta_r)
        lit, unlit = log_share(v), log_share(1 - v)
        log_passed = self.log_density + log_transmittance(passed, n.unsqueeze(-1), self.law)
        events = event_count(torch.exp(passed), n.unsqueeze(-1), self.law)
        wide = (torch.softmax(log_passed, dim=-1) * events * beta2).sum(-1)
        direct = [lit + log_norm(x) for x in own]
        scattered = [unlit + log_norm(log_passed + x) for x in own]
        near, far = lit + log_norm(back), unlit + log_norm(log_passed + back)
        around = torch.logaddexp(near, far) if self.back else torch.full_like(theta_r, -math.inf)
        shares = torch.log_softmax(torch.stack([*direct, *scattered, around], dim=-1), dim=-1)
        colour = torch.softmax(back + torch.logaddexp(lit.unsqueeze(-1), unlit.unsqueeze(-1) + log_passed), dim=-1)
        alpha = self.alpha.to(theta_r).expand(*theta_r.shape, 3)
        square = self.variance.to(theta_r).expand(*theta_r.shape, 3)
        of_back = (colour * sigma2).sum(-1) + torch.sigmoid(far - near) * wide
        centers = torch.cat([alpha, alpha, (colour * delta_b).sum(-1, keepdim=True)], dim=-1)
        squares = torch.cat([square, square + wide.unsqueeze(-1), of_back.unsqueeze(-1)], dim=-1)
        return shares, centers, torch.sqrt(squares)


def log_norm(log_value: Tensor) -> Tensor:
    """log of the Euclidean norm over channels of exp(log_value)."""
    return 0.5 * torch.logsumexp(2 * log_value, dim=-1)
