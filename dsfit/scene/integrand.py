"""The integrand of a shading point: BSDF x light x scattering."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from dsfit.arguments import check_directions, checked
from dsfit.bsdf.azimuthal import support_edges
from dsfit.bsdf.breaks import theta_breaks
from dsfit.bsdf.dual_scattering import DualScattering
from dsfit.context import Context
from dsfit.errors import InputError
from dsfit.frame import HALF_PI, theta_diff, wrap
from dsfit.scene.lights import ConstantLight, Light, TotalLight, VonMisesFisherLights
from dsfit.scene.lights.cones import ConeLight
from dsfit.scene.scattering import ConstantScattering, Scattering, SlabScattering, SphereScattering
from dsfit.special import is_differentiated


class Integrand:
    """f(omega_i) = F(omega_i, omega_r) cos(theta_i) L(omega_i), `[..., C]`: what a renderer integrates over d omega_i.

    Args:
        bsdf: the dual scattering BSDF.
        light: incident radiance; left out, a furnace of radiance 1.
        scattering: (n, v) towards each direction; left out, the context's hints everywhere.

    `integrand(omega_i, context)` takes directions `[*samples, *batch, 2]`. Channels of the BSDF and of the light must
    agree or be 1.

    Raises:
        InputError: channels that do not agree; directions not finite, or that do not broadcast with the context.

    Example:
        >>> import torch
        >>> import dsfit
        >>> furnace = dsfit.Integrand(dsfit.DualScattering(dsfit.Fiber.preset("blond")))
        >>> omega_i = torch.tensor([[0.1, 0.0], [0.1, 3.0]], dtype=torch.float64)
        >>> [[f"{x:.3f}" for x in row] for row in furnace(omega_i, dsfit.Context(0.2, n=0.0)).tolist()]
        [['0.106', '0.086', '0.057'], ['0.838', '0.764', '0.639']]
    """

    def __init__(self, bsdf: DualScattering, light: Light | None = None, scattering: Scattering | None = None) -> None:
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
        return self.bsdf.fiber.is_round and _turns(self.light) and _turns(self.scattering)

    def __call__(self, omega_i: Tensor, context: Context) -> Tensor:
        check_directions(omega_i, context.batch_shape, "omega_i")
        theta_i, phi_i = omega_i.unbind(-1)
        with checked(omega_i):
            n, v = self.scattering(omega_i, context)
            radiance = self.light(omega_i)
        phi = wrap(context.phi_r - phi_i)
        value = self.bsdf(theta_i, context.theta_r, phi, n, v, phi_h=self._phi_h(context, phi))
        return value * radiance

    def _phi_h(self, context: Context, phi: Tensor) -> Tensor | None:
        """phi_h = (phi_i + phi_r)/2 with phi_i = phi_r - phi; None for a round fibre, which does not ask."""
        return None if self.bsdf.fiber.is_round else context.phi_r - phi / 2

    def theta_breaks(self, context: Context) -> Tensor:
        """Panel ends in theta_i for one context: those of the BSDF, and the peaks of light and scattering."""
        extra = [*self.light.breakpoints()[0], *self.scattering.breakpoints()[0]]
        return theta_breaks(self.bsdf, context.theta_r, extra)

    def azimuth_edges(self, context: Context, theta_i: Tensor, *, coarse: bool = False) -> Tensor:
        """Sorted relative azimuths `[..., J]` in [-pi, pi], ends included, where the integrand has edges, caustics or
        light peaks.

        `coarse` leaves out the weak edges of N^G, which matter to the last digits only.
        """
        diff = theta_diff(theta_i, context.theta_r)
        points = [diff.new_zeros(*diff.shape, 0)]
        if not coarse or self._lit(context):
            points.append(self._support_edges(diff, self.bsdf.terms.direct_lobes))
        if self._scatters(context):
            if not coarse:
                edges = self._support_edges(diff, self.bsdf.terms.scattered_lobes)
                points += [(edges - HALF_PI).abs(), math.pi - (edges - HALF_PI).abs()]
            points.append(torch.full_like(diff, HALF_PI).unsqueeze(-1))
        half = torch.cat(points, dim=-1)
        azimuths = [] if self.is_even else self.scattering.breakpoints()[1]
        extra = [float(wrap(context.phi_r.detach() - p)) for p in azimuths]
        fixed = torch.tensor([-math.pi, 0.0, math.pi, *extra], dtype=theta_i.dtype).expand(*theta_i.shape, -1)
        lights = [] if self.is_even else [self._light_edges(context, theta_i)]
        return torch.sort(torch.cat([half, -half, fixed, *lights], dim=-1), dim=-1).values.detach()

    def _support_edges(self, diff: Tensor, lobes: tuple[int, ...]) -> Tensor:
        fiber = self.bsdf.fiber
        if fiber.is_round:
            return support_edges(fiber, diff, lobes=lobes)
        # the edges move with phi_h: take those of both principal orientations
        both = [support_edges(fiber, diff, torch.full_like(diff, a), lobes) for a in (0.0, HALF_PI)]
        return torch.cat(both, dim=-1)

    def _light_edges(self, context: Context, theta_i: Tensor) -> Tensor:
        """Relative azimuths of the light's edges, `[..., J]`, continuous in theta_i: one that leaves [-pi, pi] stays at
        the end, and a second one comes in at the other."""
        centre, offset, reach = self.light.azimuth_edges(theta_i.detach())
        base = wrap(context.phi_r.detach() - centre)
        edges = base - offset
        leaves = base.abs() + reach > math.pi
        again = edges[..., leaves] - 2 * math.pi * torch.where(base[leaves] < 0, -1.0, 1.0)
        return torch.cat([edges, again], dim=-1).clamp(-math.pi, math.pi)

    def _lit(self, context: Context) -> bool:
        constant = isinstance(self.scattering, ConstantScattering)
        shared = not constant or self.bsdf.convention.share == "sum" or bool((context.v != 0).any())
        return shared and bool(self.bsdf.terms.direct)

    def _scatters(self, context: Context) -> bool:
        constant = isinstance(self.scattering, ConstantScattering)
        shared = not constant or self.bsdf.convention.share == "sum" or bool((context.v != 1).any())
        return shared and bool(self.bsdf.terms.scattered)


def _turns(surroundings: Light | Scattering) -> bool:
    """Whether light or scattering stays the same when turned about the fibre: constant, or with its axes (mean
    directions, the normal of a slab, the offset in a ball) along the tangent.
    """
    if isinstance(surroundings, ConstantLight | ConstantScattering):
        return True
    if isinstance(surroundings, TotalLight):
        return all(map(_turns, surroundings.lights))
    if isinstance(surroundings, VonMisesFisherLights):
        axes = surroundings.to_fibre_means()
    elif isinstance(surroundings, ConeLight):
        cone = surroundings.cone()
        axes = torch.where((cone.rise > 1.5)[..., None], cone.axis.new_tensor([1.0, 0.0, 0.0]), cone.axis)
    elif isinstance(surroundings, SlabScattering):
        axes = surroundings.normal
    elif isinstance(surroundings, SphereScattering):
        axes = surroundings.offset
    else:
        return False
    return not is_differentiated(axes) and bool((axes[..., 1:].abs() <= 1e-16).all())


__all__ = ["Integrand"]
