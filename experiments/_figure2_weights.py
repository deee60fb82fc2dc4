"""What the weights of a technique's samples say of its error before anything is rendered: by quadrature over the
light's directions, at hits of some pixels."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from dsfit.experiment.compare_render_painter import Painter, Part, Picture
from dsfit.mis.heuristics import Balance
from dsfit.mis.variance import mis_variance
from dsfit.proposals.mixture import log_sum_exp
from dsfit.race.density import DensitySampler
from dsfit.race.peer import Sampler
from dsfit.random import uniform_chunks
from dsfit.render.techniques.mixed import LightAt, MixSampler
from dsfit.render.techniques.split import ChosenSampler, SplitSampler
from dsfit.scene.lights import ConstantLight

WEIGHTS = np.logspace(-1, 8, 91)
"""Weights, in units of the mean, at which tails are given."""
_INSIDE = math.pi * (1 - 1e-4)  # width in theta of the directions uniform in it: no pole in float32
_AT_ONCE = 32  # hits whose nodes are held at once


@dataclass(frozen=True)
class Prediction:
    """Mean over the hits of some pixels.

    Attributes:
        relative: for every pixel, the mean over channels of N Var / (r^2 + eps), `[P]`: the square of the relative
            error that N samples per hit have is its mean over N.
        survival: probability of a weight above `WEIGHTS`.
        moment: share of the second moment in weights above `WEIGHTS`.
    """

    relative: np.ndarray
    survival: np.ndarray
    moment: np.ndarray

    def error(self, samples: int) -> tuple[float, float]:
        """Relative error of a picture with so many samples per hit, and its standard error from the choice of
        pixels."""
        mean = float(self.relative.mean()) / samples
        spread = float(self.relative.std()) / math.sqrt(len(self.relative)) / samples
        return math.sqrt(mean), spread / (2 * math.sqrt(mean)) if mean > 0 else 0.0


def some_pixels(picture: Picture, count: int, seed: int) -> list[Part]:
    """The hits of about `count` random pixels of a picture."""
    generator = torch.Generator().manual_seed(seed)
    names = torch.cat([part.pixel.unique() for part in picture.parts])
    chosen = names[torch.randperm(len(names), generator=generator)[:count]]
    found = []
    for part in picture.parts:
        mask = torch.isin(part.pixel, chosen)
        if bool(mask.any()):
            hits = part.hits[mask]
            found.append(Part(hits, picture.scene.contexts(hits), part.pixel[mask]))
    return found


@torch.no_grad()
def predict(
    painter: Painter, parts: list[Part], samples: int, nodes: int, radiance: Tensor, eps: float
) -> Prediction | None:
    """The prediction for pictures of `samples` per hit with random points; None for a sampler that does not tell its
    densities.

    Args:
        painter: ready to paint.
        parts: hits of whole pixels.
        nodes: directions of quadrature at every hit.
        radiance: the reference `[H, W, C]`; `eps`: as in the measured error.
    """
    variances, pixels, tails = [], [], []
    for part in parts:
        for first in range(0, len(part.pixel), _AT_ONCE):
            hits = part.hits[first : first + _AT_ONCE]
            contexts, names = painter.picture.scene.contexts(hits), part.pixel[first : first + _AT_ONCE]
            sampler = _chosen(painter.technique.at(hits, contexts, names), samples)
            omega, weight = _nodes(painter, contexts, nodes)
            value = painter.technique.problem.integrand(omega, contexts).double()
            laws = _laws(sampler, omega)
            if laws is None:
                return None
            log_p, variance = _variance(sampler, *laws, value, weight)
            variances.append(variance)
            pixels.append(names)
            tails.append(_tails(value, weight, log_p))
    subsamples = painter.picture.scene.subsamples
    names, place = torch.cat(pixels).unique(return_inverse=True)
    total = torch.zeros(len(names), radiance.shape[-1], dtype=torch.float64)
    total.index_add_(0, place, torch.cat(variances).expand(-1, radiance.shape[-1]) / subsamples**2)
    r = radiance.reshape(-1, radiance.shape[-1])[names].double()
    survival, moment = (torch.cat([tail[k] for tail in tails]).mean(0).numpy() for k in range(2))
    return Prediction((total / (r.square() + eps)).mean(-1).numpy(), survival, moment)


def _chosen(sampler: Sampler, samples: int) -> Sampler:
    if isinstance(sampler, ChosenSampler):
        return sampler.few if samples < sampler.boundary else sampler.many
    return sampler


def _laws(sampler: Sampler, omega: Tensor) -> tuple[Tensor, Tensor] | None:
    """Log densities `[S, Q, H]` of the strategies and their shares `[S]` or `[S, H]`, float64."""
    if isinstance(sampler, DensitySampler):
        laws, shares = [sampler.distribution], torch.ones(1)
    elif isinstance(sampler, MixSampler):
        laws, shares = sampler.distributions, torch.as_tensor(sampler.shares)
    elif isinstance(sampler, SplitSampler):
        laws, shares = [sampler.lobes, sampler.light(sampler.contexts)], sampler.shares
    else:
        return None
    each = [law.log_prob(omega).expand(omega.shape[:-1]).double() for law in laws]
    return torch.stack(each), shares.double()


def _variance(sampler: Sampler, log_p: Tensor, shares: Tensor, value: Tensor, weight: Tensor) -> tuple[Tensor, Tensor]:
    """Log density of all samples together `[Q, H]`, and N Var `[H, C]` of an estimate by N samples.

    Shares that differ from hit to hit are taken as chances; fixed numbers of samples have no more variance than that.
    """
    wide = shares.unsqueeze(-1) if shares.ndim == 1 else shares
    mix = log_sum_exp((log_p + torch.log(wide).unsqueeze(1)).movedim(0, -1))
    if isinstance(sampler, MixSampler) and shares.ndim == 1:
        rule = "balance" if isinstance(sampler.rule, Balance) else sampler.rule
        return mix, mis_variance(value, weight, log_p, shares, rule, model=sampler.model).variance
    second = (value.square() * (weight * torch.exp(-mix)).unsqueeze(-1)).sum(0)
    return mix, (second - (value * weight.unsqueeze(-1)).sum(0).square()).clamp_min(0)


def _tails(value: Tensor, weight: Tensor, log_p: Tensor) -> tuple[Tensor, Tensor]:
    """Chance of weights |F| / p above `WEIGHTS` (in units of int |F|), and their share of int |F|^2 / p, `[H, W]`."""
    norm = torch.linalg.vector_norm(value, dim=-1)
    size = torch.log(norm.clamp_min(1e-300)) - log_p - torch.log((norm * weight).sum(0).clamp_min(1e-300))
    chance, second = weight * torch.exp(log_p), norm.square() * weight * torch.exp(-log_p)
    order = torch.argsort(size, dim=0, descending=True)
    edges = torch.log(torch.as_tensor(WEIGHTS)).expand(size.shape[1], -1)
    above = torch.searchsorted((-size.gather(0, order)).T.contiguous(), (-edges).contiguous())
    found = []
    for part in (chance, second):
        running = torch.cat([torch.zeros(1, size.shape[1]), part.gather(0, order).cumsum(0)]).T
        whole = running[:, -1:] if part is second else torch.ones(1)
        found.append(running.gather(1, above) / whole.clamp_min(1e-300))
    return found[0], found[1]


def _nodes(painter: Painter, contexts: Any, count: int) -> tuple[Tensor, Tensor]:
    """Directions `[Q, H, 2]` and solid-angle weights `[Q, H]`, the same uniform numbers at every hit.

    Half of `count` are uniform over the sphere, half uniform in theta, because the tails of longitudinal lobes lie
    around the poles; a quarter as many come from the light. Weights are 1 over the sum of densities times counts.
    """
    problem, light = painter.technique.problem, painter.picture.scene.light
    size, half, few = len(contexts.n), max(1, count // 2), max(1, count // 4)
    u, other = (_points(half, 2, seed, contexts.dtype) for seed in (1, 2))
    theta = torch.cat([torch.asin((2 * u[:, 0] - 1).clamp(-1 + 1e-7, 1 - 1e-7)), (other[:, 0] - 0.5) * _INSIDE])
    phi = (2 * torch.cat([u[:, 1], other[:, 1]]) - 1) * math.pi
    omega = torch.stack([theta, phi], dim=-1)[:, None].expand(-1, size, -1)
    law = None
    if not isinstance(light, ConstantLight):
        law = LightAt(problem.integrand)(contexts)  # type: ignore[arg-type]
        lit = law.sample(_points(few, law.dimension, 3, contexts.dtype)[:, None].expand(-1, size, -1))
        omega = torch.cat([omega, lit])
    inclination = half / (2 * math.pi * _INSIDE * torch.cos(omega[..., 0].double()).clamp_min(1e-6))
    density = half / (4 * math.pi) + torch.where(omega[..., 0].abs() < _INSIDE / 2, inclination, 0.0)
    if law is not None:
        density = density + few * torch.exp(law.log_prob(omega).double())
    return omega, 1 / density


def _points(count: int, dimension: int, seed: int, dtype: torch.dtype) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    pieces = uniform_chunks((count,), dimension, generator=generator, kind="sobol", rows=count, dtype=dtype)
    return torch.cat(list(pieces))
