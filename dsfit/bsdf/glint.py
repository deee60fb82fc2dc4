"""Treatment of the TRT caustic (Marschner et al. 2003, section 5.2.2): the singularity is replaced by a Gaussian
glint.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from dsfit.bsdf.attenuation import Absorption, caustic_attenuation
from dsfit.bsdf.fiber import Fiber
from dsfit.bsdf.snell import Caustic, Refraction, cos_refracted
from dsfit.frame import wrap
from dsfit.special import log_gauss, normal_mass


@dataclass(frozen=True)
class Glint:
    """The two Gaussians at +-phi_c, and the factor that removes the singular peaks.

    With fade t (1 for eta' < 2, falling smoothly to 0 at eta' = 2 + Delta eta'): `L <- L (1 - t e^{-(phi - phi_c)^2 /
    2 w_c^2}) (1 - t e^{-(phi + phi_c)^2 / 2 w_c^2}) + t k_G A(2, h_c) Delta h [g(phi - phi_c; w_c) + g(phi + phi_c;
    w_c)]`
    """

    fade: Tensor
    phi: Tensor
    width: Tensor
    strength: Tensor

    @staticmethod
    def of(fiber: Fiber, refraction: Refraction, caustic: Caustic, absorption: Absorption) -> Glint:
        """Glint of a fibre at given refraction; `strength` is t k_G A(2, h_c) Delta h, `[..., C]`."""
        kappa = refraction.kappa
        over = (1 / kappa.clamp_min(1e-30) - 2) / fiber.caustic_fade
        x = over.clamp(0.0, 1.0)
        fade = torch.where(caustic.folded, 1.0, 1 - x * x * (3 - 2 * x))
        sin_gamma, cos_gamma = torch.sin(caustic.gamma), torch.cos(caustic.gamma)
        # d2 phi / d h2 at the fold: 4 h kappa^3 / cos^3 gamma_t - 2 h / cos^3 gamma
        q = cos_refracted(kappa, sin_gamma)
        bend = (2 * sin_gamma * (1 / cos_gamma**3 - 2 * kappa**3 / q**3)).abs()
        safe = torch.where(caustic.folded, bend, 1.0).clamp_min(1e-12)
        offset = torch.minimum(fiber.caustic_max_offset, 2 * torch.sqrt(2 * fiber.caustic_width / safe))
        offset = torch.where(caustic.folded, offset, fiber.caustic_max_offset)
        carried = caustic_attenuation(refraction, caustic, fiber.sigma_a, absorption)
        strength = (fade * fiber.glint_scale * offset).unsqueeze(-1) * carried
        return Glint(fade, caustic.phi, fiber.caustic_width, strength)

    def removal(self, phi: Tensor) -> Tensor:
        """The factor (1 - t e^..)(1 - t e^..); 1 - e^-x by expm1, so that it vanishes exactly like the square it is."""
        return self._remove(wrap(phi - self.phi)) * self._remove(wrap(phi + self.phi))

    def _remove(self, x: Tensor) -> Tensor:
        return (1 - self.fade) - self.fade * torch.expm1(-0.5 * (x / self.width) ** 2)

    def added(self, phi: Tensor) -> Tensor:
        """The glints' share of N_TRT, `[..., C]`."""
        left, right = wrap(phi - self.phi), wrap(phi + self.phi)
        shape = torch.exp(log_gauss(left, self.width)) + torch.exp(log_gauss(right, self.width))
        return shape.unsqueeze(-1) * self.strength

    def added_mass(self, phi: Tensor) -> Tensor:
        """Integral of `added` over the half circle centred on phi, `[..., C]`."""
        shape = _window_mass(wrap(phi - self.phi), self.width) + _window_mass(wrap(phi + self.phi), self.width)
        return shape.unsqueeze(-1) * self.strength


def _window_mass(distance: Tensor, width: Tensor) -> Tensor:
    """int g(wrap(x); width) dx over |x - distance| < pi/2, for |distance| <= pi; the window may reach across pi."""
    d = distance.abs()
    high = d + math.pi / 2
    reach = high.clamp_max(math.pi)
    crossed = (high - 2 * math.pi).clamp_min(-math.pi)
    mass = normal_mass((d - math.pi / 2) / width, reach / width)
    return mass + normal_mass(torch.full_like(d, -math.pi) / width, crossed / width)

