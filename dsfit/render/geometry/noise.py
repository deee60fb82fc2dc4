"""Smooth randomness: what neighbouring strands share, and what each has for itself."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from dsfit.render.geometry.build import along, normal, uniform


class Field:
    """A smooth random vector field: a sum of plane waves with random directions and phases.

    Each component has mean 0 and mean square 1 over space. Strands that grow close to each other are displaced alike,
    which is what makes them look combed together.

    Args:
        length: wavelength of the longest waves; the shortest have a third of it.
        generator: of the randomness.
        waves: how many waves make each component.
    """

    def __init__(self, length: float, generator: torch.Generator, waves: int = 12) -> None:
        direction = normal((3, waves, 3), generator)
        direction = direction / direction.norm(dim=-1, keepdim=True).clamp_min(1e-12)
        self.wave = direction * (2.0 * math.pi / length) * uniform((3, waves, 1), generator, 1.0, 3.0)
        self.phase = uniform((3, waves), generator, 0.0, 2.0 * math.pi)

    def __call__(self, position: Tensor) -> Tensor:
        """The field `[..., 3]` at positions `[..., 3]`."""
        scale = math.sqrt(2.0 / self.phase.shape[1])
        parts = [
            torch.sin(position @ wave.T + phase).sum(-1) for wave, phase in zip(self.wave, self.phase, strict=True)
        ]
        return scale * torch.stack(parts, -1)


def wander(strands: int, points: int, turns: float, generator: torch.Generator, waves: int = 4) -> Tensor:
    """A smooth random curve `[strands, points, 3]` for each strand: 0 at the root, spread near 1 at the tip.

    Each component is a sum of sines of the parameter s, the fastest of which swings `turns` times from root to tip.
    """
    s = along(points)
    curve = torch.zeros(strands, points, 3, dtype=torch.float64)
    for wave in range(1, waves + 1):
        turn = 2.0 * math.pi * turns * wave / waves
        phase = uniform((strands, 1, 3), generator, 0.0, 2.0 * math.pi)
        strength = normal((strands, 1, 3), generator) / wave
        curve += strength * (torch.sin(turn * s[:, None] + phase) - torch.sin(phase))
    return curve / math.sqrt(sum(1.0 / wave**2 for wave in range(1, waves + 1)))
