"""What light and scattering can be: radiance from any direction, n and v towards any direction."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from dsfit.scene.lights import (
    ConstantLight,
    EnvironmentLight,
    Light,
    RectangleLight,
    RingLight,
    TotalLight,
    VonMisesFisherLights,
)
from dsfit.scene.lights.cones import ConeLight
from dsfit.scene.lights.lobes import log_normaliser
from dsfit.scene.planning.boxes import Boxes, growing
from dsfit.scene.planning.interval import Interval
from dsfit.scene.scattering import THRESHOLD, ConstantScattering, Scattering, SlabScattering, SphereScattering


@dataclass(frozen=True)
class Radiance:
    """Bounds on L(omega) over all directions and on its integral over the sphere, each `[C]`."""

    low: Tensor
    high: Tensor
    total: Tensor


def radiance(light: Light) -> Radiance | None:
    """Bounds on a light; None where nothing is known of it.

    Lobes: each is largest at its mean direction, C(kappa), and least opposite to it, C(kappa) exp(-2 kappa). A map: its
    texels' least and largest, between which bilinear interpolation stays. Emitters with an edge: dark somewhere, never
    above their radiance; of several positions, the one that sees most counts. A total: the sums.
    """
    if type(light) is TotalLight:
        found = [radiance(one) for one in light.lights]
        if any(part is None for part in found):
            return None
        parts = [(part.low, part.high, part.total) for part in found if part is not None]
        return Radiance(*(sum(x) for x in zip(*parts, strict=True)))  # type: ignore[arg-type]
    if type(light) in (RectangleLight, RingLight):
        # a plane emitter fills at most half of all directions
        value = light.radiance.detach().to(torch.float64)  # type: ignore[union-attr, operator]
        return Radiance(torch.zeros_like(value), value, 2 * math.pi * value)
    if isinstance(light, ConeLight):
        value, solid = light.radiance.detach().to(torch.float64), 2 * math.pi * light.cone().rise.detach().double()
        whole = bool((solid > 3 * math.pi).all())
        return Radiance(value if whole else torch.zeros_like(value), value, value * solid.max())
    if type(light) is ConstantLight:
        value = light.radiance.detach().to(torch.float64)
        return Radiance(value, value, 4 * math.pi * value)
    if type(light) is VonMisesFisherLights:
        kappa, power = light.kappa.detach().to(torch.float64), light.intensity.detach().to(torch.float64)
        peak = torch.exp(log_normaliser(kappa))
        ambient = light.ambient.detach().to(torch.float64)
        low = torch.einsum("k,kc->c", peak * torch.exp(-2 * kappa), power) + ambient
        return Radiance(low, torch.einsum("k,kc->c", peak, power) + ambient, light.total().detach().to(torch.float64))
    if type(light) is EnvironmentLight:
        image = light.scale * light.image.detach().to(torch.float64)
        high = image.amax((0, 1))
        return Radiance(image.amin((0, 1)), high, 4 * math.pi * high)
    return None


def arrival(scattering: Scattering) -> Callable[[Boxes], tuple[Interval, Interval]]:
    """n and v, `[B, J]`, of the light that arrives at contexts in boxes `[B]`: in every direction one of the J pairs.

    Slab: n in [0, max_n]. Ball: chords between R - |p| and R + |p|. Anything unknown: n >= 0 and v in [0, 1].
    """

    def spread(boxes: Boxes) -> tuple[Interval, Interval]:
        count = len(boxes)
        if type(scattering) is ConstantScattering and scattering.from_context:
            return boxes.n.reshape(lambda x: x[:, None]), boxes.v.reshape(lambda x: x[:, None])
        if type(scattering) is ConstantScattering and scattering.n is None:
            n = boxes.n.reshape(lambda x: x[:, None])
            return n, _lit(scattering, n)
        low, high = _crossings(scattering)
        if type(scattering) is ConstantScattering or math.isinf(high):
            ends = torch.tensor([[low, high]], dtype=torch.float64)
        else:
            ends = torch.tensor(list(growing(low, high)), dtype=torch.float64)
        n = Interval(ends[:, 0].expand(count, -1), ends[:, 1].expand(count, -1))
        return n, _lit(scattering, n)

    return spread


def _crossings(scattering: Scattering) -> tuple[float, float]:
    """Least and largest n of any direction and any element of a batch."""
    if type(scattering) is ConstantScattering and scattering.n is not None:
        return float(scattering.n.detach().min()), float(scattering.n.detach().max())
    if type(scattering) is SlabScattering:
        return 0.0, scattering.max_n if float(scattering.density.detach().max()) > 0 else 0.0
    if type(scattering) is SphereScattering:
        radius, offset = scattering.radius.detach(), scattering.offset.detach().norm(dim=-1)
        density = scattering.density.detach()
        low = 0.0 if scattering.aligned else float((density * (radius - offset)).min().clamp_min(0.0))
        slack = 1 + 1e-5  # an offset may lie outside by float32's rounding
        return low / slack, float((density * (radius + offset)).max()) * slack
    return 0.0, math.inf


def _lit(scattering: Scattering, n: Interval) -> Interval:
    """v for n in intervals, by the rule."""
    if type(scattering) not in (ConstantScattering, SlabScattering, SphereScattering):
        return Interval(torch.zeros_like(n.low), torch.ones_like(n.high))
    if scattering.rule == "poisson":
        return n.falling(lambda x: torch.exp(-x))
    if scattering.rule == "threshold":
        return n.falling(lambda x: (x <= THRESHOLD).to(x))
    share = scattering.share.detach().to(n.low)  # type: ignore[union-attr]
    low, high = share.min(), share.max()
    # v = 1 wherever n = 0
    return Interval(torch.where(n.high == 0, 1.0, low), torch.where(n.low == 0, 1.0, high))


__all__ = ["Radiance", "arrival", "radiance"]
