"""Several lights at once, sampled by a mixture: each by its share of what arrives at the point."""

from __future__ import annotations

import functools
import math
import operator
from collections.abc import Callable, Sequence
from typing import Any, Self

import torch
from torch import Tensor, nn

from dsfit.context import Context
from dsfit.errors import InputError, as_real, check_range
from dsfit.proposals.base import Distribution, Proposal
from dsfit.proposals.mixture import MixtureDistribution, log_sum_exp
from dsfit.scene.lights.base import Light, LightDistribution, tidy
from dsfit.scene.lights.nearby import NearbyLight


class TotalLight(Light):
    """`L = sum_k L_k`.

    Its proposal is the mixture `sum_k s_k p_k` of the lights' own, with exact density. The shares s_k are those of the
    lights in the power that arrives at the point (`Light.power`), or as given.

    Args:
        lights: lights, each with 1 or C channels; their own rotations and positions hold.
        shares: what part of the samples each light gets, `[K]`, >= 0, normalised; None: by power. A light may get
            nothing only where another one, that gets some, is sampled in every direction (constant, for instance).

    Raises:
        InputError: no light, one that is none, channels that do not agree, shares that do not fit.
    """

    shares: Tensor | None

    def __init__(self, lights: Sequence[Light], shares: Any = None) -> None:
        super().__init__()
        lights = list(lights) if isinstance(lights, Sequence | nn.ModuleList) else [lights]
        if not lights or not all(isinstance(light, Light) for light in lights):
            raise InputError("lights", [type(light).__name__ for light in lights], "a list of at least one light")
        sizes = {light.channels for light in lights} - {1}
        if len(sizes) > 1:
            raise InputError("lights", [light.channels for light in lights], "lights of 1 or of C channels each")
        self.lights = nn.ModuleList(lights)
        self._size = max(sizes, default=1)
        self.register_buffer("shares", None if shares is None else self._checked(shares))

    def _checked(self, shares: Any) -> Tensor:
        value = check_range("shares", as_real("shares", shares, torch.float64), 0.0)
        if value.shape != (len(self.lights),) or not bool((value > 0).any()):
            raise InputError("shares", value.tolist(), f"{len(self.lights)} numbers >= 0, not all zero")
        sampled = value > 0
        covered = any(light.covers() for light, used in zip(self.lights, sampled, strict=True) if used)
        if not covered and not bool(sampled.all()):
            allowed = "shares above zero, unless a light that is sampled in every direction has one"
            raise InputError("shares", value.tolist(), allowed)
        return value / value.sum()

    @property
    def channels(self) -> int:  # type: ignore[override]
        return self._size

    @property
    def label(self) -> str:
        return f"{len(self.lights)} light" + "s" * (len(self.lights) != 1)

    def forward(self, omega_i: Tensor) -> Tensor:
        total = functools.reduce(operator.add, (light(omega_i) for light in self.lights))
        return total.expand(*total.shape[:-1], self.channels)

    def power(self) -> Tensor:
        return functools.reduce(operator.add, (light.power() for light in self.lights))

    def covers(self) -> bool:
        given = [True] * len(self.lights) if self.shares is None else (self.shares > 0).tolist()
        sampled = zip(self.lights, given, strict=True)
        return any(light.covers() and (self.shares is not None or self._glows(light)) for light, on in sampled if on)

    @staticmethod
    def _glows(light: Light) -> bool:
        return bool((light.power() > 0).all())

    def parts(self) -> Tensor:
        """Shares of the samples, `[K]` or `[*batch, K]`; equal where nothing arrives from any of the lights."""
        if self.shares is not None:
            return self.shares
        with torch.no_grad():
            power = torch.stack(torch.broadcast_tensors(*(light.power().double() for light in self.lights)), dim=-1)
            power = power.clamp_max(1e300)
            power = power / power.amax(-1, keepdim=True).clamp_min(1e-300)
            total = power.sum(-1, keepdim=True)
            return torch.where(total > 0, power / total.clamp_min(0.5), 1 / len(self.lights))

    def proposal(self) -> Proposal:
        """The mixture of the lights' proposals; one uniform more than the hungriest of them."""
        return TotalProposal(self)

    def breakpoints(self) -> tuple[list[float], list[float]]:
        found = [light.breakpoints() for light in self.lights]
        return tidy([t for thetas, _ in found for t in thetas], [p for _, phis in found for p in phis])

    def azimuth_edges(self, theta_i: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        centre, offset, reach = zip(*(light.azimuth_edges(theta_i) for light in self.lights), strict=True)
        return torch.cat(centre), torch.cat(offset, dim=-1), torch.cat(reach)

    def rotated(self, rotation: Any) -> Self:
        return self._of([light.rotated(rotation) for light in self.lights])

    def placed(self, position: Tensor, rotation: Tensor) -> Self:
        return self._of([light.placed(position, rotation) for light in self.lights])

    def taken(self, batch_shape: torch.Size, index: Tensor) -> Self | None:
        lights = [light.taken(batch_shape, index) for light in self.lights]
        return None if any(light is None for light in lights) else self._of(lights)

    def _of(self, lights: list[Any]) -> Self:
        other = self._with_buffers()
        other._modules = {"lights": nn.ModuleList(lights)}
        return other


class TotalProposal(Proposal):
    """The mixture of several lights' proposals."""

    def __init__(self, light: TotalLight) -> None:
        super().__init__()
        self.light = light

    def forward(self, context: Context) -> TotalDistribution:
        parts = [light.proposal()(context) for light in self.light.lights]  # type: ignore[operator]
        return TotalDistribution(parts, self.light.parts().to(context.device))


class TotalDistribution(MixtureDistribution):
    """`p = sum_k s_k p_k`; shares may be zero, and such a light is never drawn from.

    Args:
        components: the p_k.
        shares: s_k, `[K]` or `[*batch, K]`.
    """

    def __init__(self, components: Sequence[Distribution], shares: Tensor) -> None:
        lit = shares > 0
        super().__init__(components, torch.where(lit, torch.log(torch.where(lit, shares, 1.0)), -math.inf))
        self.shares = shares
        edges = shares.cumsum(dim=-1)
        # from the last light with a share on, the edge lies beyond every uniform
        last = edges >= edges[..., -1:]
        self._edges = torch.where(last, 2.0, edges)[..., :-1]

    def selected(self, u: Tensor) -> Tensor:
        return (u[..., None] >= self._edges.to(u)).sum(dim=-1)

    def log_prob(self, omega: Tensor) -> Tensor:
        return log_sum_exp(self.component_log_probs(omega) + self.log_weights.to(omega))

    def _restrict(self, component: Distribution, index: Tensor) -> Distribution | None:
        # What a nearby light prepares for one point takes longer than to draw from it everywhere.
        nearby = isinstance(component, LightDistribution) and isinstance(component.light, NearbyLight)
        return None if nearby and len(self.batch_shape) else super()._restrict(component, index)

    def select(self, take: Callable[[Tensor], Tensor]) -> TotalDistribution | None:
        components = [component.select(take) for component in self.components]
        if any(component is None for component in components):
            return None
        shares = self.shares
        if shares.dim() > 1:
            shares = torch.stack([take(column) for column in shares.unbind(-1)], dim=-1)
        return TotalDistribution(components, shares)  # type: ignore[arg-type]
