"""More passes for the pixels that need them, in two stages."""

from __future__ import annotations

import time

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d

from dsfit.errors import as_number
from dsfit.render.integrator import Accumulated, TilePixels, accumulate, check_tile, pixel_names, tile_of
from dsfit.render.scene import RenderScene
from dsfit.render.techniques.technique import Technique

_DIM = 0.02
"""Pixels darker than this part of the tile's mean count as if they were that bright."""


def render_adaptive(
    scene: RenderScene,
    technique: Technique,
    rows: range,
    columns: range,
    *,
    samples: int,
    pilot: int,
    passes: int,
    seed: int,
    most: float = 8.0,
) -> TilePixels:
    """A tile with `pilot` passes everywhere, then `passes` more on average, spread to lower the relative error.

    For the least sum of relative variances at a given number of directions, pixel p gets n_p passes in proportion to
    `s_p / (L_p + eps) / sqrt(h_p)`: s_p^2 the variance of a pass, L_p the mean radiance (over channels), h_p its hits,
    eps 2 % of the tile's mean. Both s_p and L_p are taken from the pilots of the pixel's eight neighbours, not from its
    own. So n_p is independent of the pixel's own numbers, the pilot enters with its share of the passes, pilot / (pilot
    + n_p), and value and variance are unbiased.

    n_p is rounded to one of 2, 4, 8, 16, ... passes, at most `most` times the average. The picture depends on the
    tiling.

    Args:
        scene, technique, rows, columns, samples, seed: as for `render_tile`.
        pilot: passes of the first stage, >= 2.
        passes: mean number of further passes, >= 2.
        most: >= 1.

    Raises:
        InputError: as `render_tile`.
    """
    start = time.process_time()
    check_tile(scene, rows, columns, samples=samples, passes=passes)
    check_tile(scene, rows, columns, passes=pilot)
    most = as_number("most", most, 1.0)
    technique.prepare(scene)
    hits, names, shape = scene.hits(rows, columns), pixel_names(scene, rows, columns), (len(rows), len(columns))
    first = accumulate(scene, technique, hits, names, samples, range(pilot), seed)
    counts = torch.bincount(hits.pixel, minlength=len(names))
    more = allocate(first, counts.reshape(shape), pilot, passes, most)
    mean, variance = first.mean.clone(), first.variance.clone()
    for n in torch.unique(more[counts > 0]).tolist():
        chosen = hits[more[hits.pixel] == n]
        found = accumulate(scene, technique, chosen, names, samples, range(pilot, pilot + n), seed)
        where, share = torch.unique(chosen.pixel), pilot / (pilot + n)
        mean[where] = share * first.mean[where] + (1 - share) * found.mean[where]
        variance[where] = share**2 * first.variance[where] + (1 - share) ** 2 * found.variance[where]
    whole = Accumulated(mean, variance, first.hint)
    return tile_of(scene, hits, shape, whole, samples * (pilot + more), start)


def allocate(pilot: Accumulated, counts: Tensor, pilots: int, passes: int, most: float) -> Tensor:
    """Further passes `[P]` of every pixel, from its neighbours' pilots; `counts` `[h, w]` are its hits."""
    hit = counts.reshape(-1) > 0
    spread = (pilot.variance.sum(-1) * pilots).reshape(counts.shape)
    level = pilot.mean.mean(-1).reshape(counts.shape)
    around = _neighbours(torch.stack([spread, level, (counts > 0).double()])).flatten(1)
    some = around[2].clamp_min(1.0)
    average = float(level.reshape(-1)[hit].mean()) if bool(hit.any()) else 1.0
    need = (around[0] / some).sqrt() / (around[1] / some + _DIM * average).clamp_min(1e-300)
    need = torch.where(around[2] > 0, need, need[hit].mean() if bool(hit.any()) else 1.0)
    need = need / counts.reshape(-1).clamp_min(1).double().sqrt()
    cost = counts.reshape(-1).double()
    least, high = 2.0, most * passes
    scale = passes * cost.sum() / (cost * need).sum().clamp_min(1e-300)
    for _ in range(20):  # what is cut off at either end goes to the others
        wanted = (scale * need).clamp(least, high)
        scale = scale * passes * cost.sum() / (cost * wanted).sum().clamp_min(1e-300)
    return _rounded(wanted)


def _neighbours(layers: Tensor) -> Tensor:
    """Sums `[K, h, w]` over the eight neighbours, those within the tile; layers are 0 where nothing is hit."""
    return avg_pool2d(layers.unsqueeze(0), 3, 1, 1, divisor_override=1)[0] - layers


def _rounded(wanted: Tensor) -> Tensor:
    """To the nearest of 2, 4, 8, 16, ... by ratio."""
    steps = torch.tensor([2 << k for k in range(24)], dtype=torch.float64)
    edges = (steps[1:] * steps[:-1]).sqrt()
    return steps.long()[torch.bucketize(wanted, edges)]


__all__ = ["allocate", "render_adaptive"]
