"""The integrand of a shading point: BSDF x light x scattering."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from dsfit.bsdf.azimuthal import support_edges
from dsfit.bsdf.dual_scattering import DualScattering
from dsfit.context import Context
from dsfit.errors import InputError
from dsfit.frame import HALF_PI, theta_diff, wrap
from dsfit.quadrature import merge_breaks
from dsfit.scene.lights import ConstantLight, Light
from dsfit.scene.scattering import ConstantScattering, Scattering


class Integrand:
    """f(omega_i) = F(omega_i, omega_r) cos(theta_i) L(omega_i), `[..., C]`: what a renderer integrates over d omega_i.

    Args:
        bsdf: the dual scattering BSDF.
        light: incident radiance; left out, a furnace of radiance 1.
        scattering: (n, v) towards each direction; left out, the context's hints everywhere.

    `integrand(omega_i, context)` takes directions `[*samples, *batch, 2]`. Channels of the BSDF and of the light must agree or be 1.
    """

    def __init__(
        self, bsdf: DualScattering, light: Light | None = None, scattering: Scattering | None = None
    ) -> None:
        self.bsdf = bsdf
        self.light = ConstantLight() if light is None else light
        self.scattering = ConstantScattering() if scattering is None else scattering
        sizes = {bsdf.channels, self.light.channels} - {1}
        if len(sizes) > 1:
            raise InputError("light.channels", self.light.channels, f"1 or the BSDF's {bsdf.channels}")

    @property
    def channels(self) -> int:
        """Number of channels C."""
        return max(self.bsdf.channels, self.light.channels)

    @property
    def is_even(self) -> bool:
        """Whether the integrand is an even function of the relative azimuth, whatever the context."""
        plain = isinstance(self.light, ConstantLight) and isinstance(self.scattering, ConstantScattering)
        return plain and self.bsdf.fiber.is_round

    def __call__(self, omega_i: Tensor, context: Context) -> Tensor:
        theta_i, phi_i = omega_i.unbind(-1)
        n, v = self.scattering(omega_i, context)
        phi = wrap(context.phi_r - phi_i)
        value = self.bsdf(theta_i, context.theta_r, phi, n, v, phi_h=self._phi_h(context, phi))
        return value * self.light(omega_i)

    def _phi_h(self, context: Context, phi: Tensor) -> Tensor | None:
        """phi_h = (phi_i + phi_r)/2 with phi_i = phi_r - phi; None for a round fibre, which does not ask."""
        return None if self.bsdf.fiber.is_round else context.phi_r - phi / 2

    def theta_breaks(self, context: Context) -> Tensor:
        """Panel ends in theta_i for one context: lobe centres and flanks, jumps of the TRT lobe, peaks of the light."""
        fiber, theta_r = self.bsdf.fiber, context.theta_r.detach()
        alpha, beta = fiber.alpha.detach().to(theta_r), fiber.beta.detach().to(theta_r)
        steps = torch.tensor([-8.0, -4.0, -2.0, 0.0, 2.0, 4.0, 8.0], dtype=theta_r.dtype)
        points = [(2 * alpha[:, None] + 2 * beta[:, None] * steps - theta_r).flatten()]
        if self.bsdf.convention.back_argument == "theta_diff+theta_r":
            points.append(3 * theta_r.reshape(1))
        average = self.bsdf.averages(-theta_r)
        center = (2 * average.delta_b - theta_r).detach().flatten()
        points += [center, center - 4 * average.sigma_b.detach().flatten(), center + 4 * average.sigma_b.detach().flatten()]
        points += [theta_r + 2 * s * t for t in self._jumps() for s in (-1, 1)]
        extra = [*self.light.breakpoints()[0], *self.scattering.breakpoints()[0], -1.2, -0.7, 0.0, 0.7, 1.2]
        points.append(torch.tensor(extra, dtype=theta_r.dtype))
        return merge_breaks(torch.cat([p.reshape(-1) for p in points]), -HALF_PI, HALF_PI, 1e-7)

    def _jumps(self) -> list[Tensor]:
        """theta_diff at which eta' = sqrt 2, 2, or the end of the glint's fade, for a round fibre."""
        fiber = self.bsdf.fiber
        found = []
        for target in (math.sqrt(2.0), 2.0, 2.0 + float(fiber.caustic_fade.detach())):
            cos2 = (float(fiber.eta.detach()) ** 2 - 1) / (target * target - 1)
            if 0 < cos2 < 1:
                found.append(torch.acos(torch.tensor(math.sqrt(cos2), dtype=fiber.dtype)).reshape(1))
        return found

    def azimuth_edges(self, context: Context, theta_i: Tensor) -> Tensor:
        """Sorted relative azimuths `[..., J]` in [-pi, pi], ends included, where the integrand has edges, caustics or light peaks."""
        diff = theta_diff(theta_i, context.theta_r)
        fiber = self.bsdf.fiber
        if fiber.is_round:
            edges = support_edges(fiber, diff)
        else:  # the edges move with phi_h: take those of both principal orientations
            both = [support_edges(fiber, diff, torch.full_like(diff, a)) for a in (0.0, HALF_PI)]
            edges = torch.cat(both, dim=-1)
        points = [edges]
        if self._scatters(context):
            shifted = torch.cat([(edges - HALF_PI).abs(), math.pi - (edges - HALF_PI).abs()], dim=-1)
            points += [shifted, torch.full_like(diff, HALF_PI).unsqueeze(-1)]
        half = torch.cat(points, dim=-1)
        extra = [float(wrap(context.phi_r.detach() - p)) for p in self._light_azimuths()]
        fixed = torch.tensor([-math.pi, 0.0, math.pi, *extra], dtype=theta_i.dtype).expand(*theta_i.shape, -1)
        return torch.sort(torch.cat([half, -half, fixed], dim=-1), dim=-1).values.detach()

    def _light_azimuths(self) -> list[float]:
        return [*self.light.breakpoints()[1], *self.scattering.breakpoints()[1]]

    def _scatters(self, context: Context) -> bool:
        constant = isinstance(self.scattering, ConstantScattering)
        return not constant or self.bsdf.convention.share == "sum" or bool((context.v != 1).any())


__all__ = ["Integrand"]
