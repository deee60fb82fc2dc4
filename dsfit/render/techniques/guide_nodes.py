"""Directions at which hits are asked how much light comes through."""

from __future__ import annotations

import torch
from torch import Tensor

from dsfit.context import Context
from dsfit.frame import to_angles, to_vector
from dsfit.random import uniforms
from dsfit.render.grid.table import DirectionalTable, directions
from dsfit.render.integrand import HairIntegrand
from dsfit.scene.lights import Light


class Nodes:
    """`rows` x `columns` directions of equal solid angle, and `lights` of light sampling.

    Light at infinity is the same for all hits: its directions, radiances and densities are found once, and n at all
    directions is looked up in a table over the grid. Nearby lights are asked at every hit, and n towards their samples
    is marched.

    Args:
        integrand: of the scene.
        rows, columns, lights: numbers of directions; `lights` may be 0.
        seed: of the light's samples.
    """

    def __init__(self, integrand: HairIntegrand, rows: int, columns: int, lights: int, seed: int) -> None:
        self.integrand, self.lights = integrand, lights
        light, grid = integrand.light, getattr(integrand.scattering, "grid", None)
        around = directions(rows, columns).reshape(-1, 3)
        self.around = around
        self.far = bool(lights) and type(light).placed is Light.placed
        if lights:
            dimension = light.proposal()(Context(0.0)).dimension
            generator = torch.Generator().manual_seed(seed)
            self.u = uniforms((lights,), dimension, generator=generator, kind="sobol", dtype=torch.float32)
        if self.far:
            distribution = light.proposal()(Context(0.0, dtype=torch.float32))
            around = torch.cat([around, to_vector(distribution.sample(self.u)).double()])
            omega = to_angles(around).float()
            self.radiance = light(omega).unsqueeze(1)
            self.density = torch.exp(distribution.log_prob(omega)).unsqueeze(1)
        self.fixed = around
        self.table = None
        if grid is not None:
            axes = [torch.linspace(0, 1, size, dtype=torch.float64) for size in grid.table.n.shape[:3]]
            place = torch.stack(torch.meshgrid(*axes, indexing="ij"), dim=-1)
            points = grid.low + place * (grid.high - grid.low)
            n = grid.crossings(points[..., None, :].float(), around.float())
            self.table = DirectionalTable(n.unsqueeze(-2), grid.low, grid.high)

    def at(
        self, contexts: Context
    ) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor | None, Tensor | None]:
        """Directions `[Q, H, 2]`, weights `[Q, H]` (or `[Q, 1]`), n and v `[Q, H]`, radiances `[Q, H, C]` and densities
        of light sampling `[Q, H]` (both None without lights) for the hits of these contexts."""
        integrand, scattering = self.integrand, self.integrand.scattering
        hit = contexts.hit  # type: ignore[attr-defined]
        position, frame = integrand.hits.position[hit], integrand.hits.frame[hit]
        omega = to_angles(torch.einsum("dj,hij->dhi", self.fixed.to(frame), frame))
        if self.table is None:
            n, v = scattering(omega, contexts)
        else:
            n = self.table.at(position).reshape(len(position), -1).t().contiguous()
            v = scattering.lit_share(n, contexts)
        radiance, density = (self.radiance, self.density) if self.far else (None, None)
        if self.lights and not self.far:
            light = integrand.light.placed(position, frame)
            distribution = light.proposal()(contexts)
            own = distribution.sample(self.u.unsqueeze(1).expand(-1, len(position), -1))
            more = scattering(own, contexts)
            omega, n, v = torch.cat([omega, own]), torch.cat([n, more[0]]), torch.cat([v, more[1]])
            radiance, density = light(omega), torch.exp(distribution.log_prob(omega))
        count = len(self.around) / (4 * torch.pi)
        weight = omega.new_ones(1, 1) if density is None else 1 / (count + self.lights * density)
        return omega, weight, n, v, radiance, density
