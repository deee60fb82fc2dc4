"""Tiles of a picture: independent passes over groups of hits, their mean and its variance."""

from __future__ import annotations

import time
from dataclasses import dataclass

import torch
from torch import Tensor

from dsfit.errors import InputError
from dsfit.race.peer import CHUNK, Sampler
from dsfit.render.hits import Hits
from dsfit.render.scene import RenderScene
from dsfit.render.techniques.technique import Technique

GROUP = 2**13
"""Hits that are prepared and sampled together, to the whole pixel."""


@dataclass(frozen=True)
class TilePixels:
    """A tile of the picture, float64.

    Attributes:
        radiance: `[h, w, C]`, mean over the sub-pixel rays and passes; rays that meet nothing see the background.
        variance: `[h, w, C]` of that mean over the random directions, from the spread of the passes; the places of the
            rays are fixed.
        samples: `[h, w]`, directions drawn.
        n: `[h, w]`, mean over the hits of the hint n; 0 where nothing is hit.
        coverage: `[h, w]`, share of rays that meet a fibre.
        depth: `[h, w]`, mean distance of the hits from the camera; 0 where nothing is hit.
        seconds: CPU seconds of this process, rays included, preparation of the technique not.
    """

    radiance: Tensor
    variance: Tensor
    samples: Tensor
    n: Tensor
    coverage: Tensor
    depth: Tensor
    seconds: float


@dataclass(frozen=True)
class Accumulated:
    """Mean over passes of what the hits add to each pixel and its variance `[P, C]`, and the sum `[P]` of the hits'
    hints n."""

    mean: Tensor
    variance: Tensor
    hint: Tensor


def render_tile(
    scene: RenderScene,
    technique: Technique,
    rows: range,
    columns: range,
    *,
    samples: int,
    passes: int,
    seed: int,
) -> TilePixels:
    """The pixels of a tile with `samples` directions per hit in each of `passes` independent passes.

    The same seed gives the same random numbers in a pixel whatever the tile: pictures agree to rounding between
    tilings, and bit for bit between runs. Exceptions: techniques that work context by context ("fitted", "structured",
    "vegas", "best_mix" of the race) and the optimal heuristic number their draws by the hits before them, so theirs
    depend on the tile.

    Memory: about `hits x (400 + 8 C)` bytes for the tile's hits (rows x columns x subsamples, at most) and, beside the
    technique's own tables, `max(CHUNK, GROUP) x 500` bytes for directions at work.

    Raises:
        InputError: arguments out of range; an estimate that is not finite (names technique and pixel).
    """
    start = time.process_time()
    check_tile(scene, rows, columns, samples=samples, passes=passes)
    technique.prepare(scene)
    hits = scene.hits(rows, columns)
    names = pixel_names(scene, rows, columns)
    found = accumulate(scene, technique, hits, names, samples, range(passes), seed)
    count = torch.full((len(names),), samples * passes)
    return tile_of(scene, hits, (len(rows), len(columns)), found, count, start)


def pixel_names(scene: RenderScene, rows: range, columns: range) -> Tensor:
    """The numbers `[P]` of a tile's pixels in the picture."""
    return (torch.tensor(rows)[:, None] * scene.camera.width + torch.tensor(columns)).reshape(-1)


def tile_of(
    scene: RenderScene, hits: Hits, shape: tuple[int, int], found: Accumulated, samples: Tensor, start: float
) -> TilePixels:
    """The tile's layers from what its hits add up to and the directions per hit `[P]`."""
    counts = torch.bincount(hits.pixel, minlength=len(samples))
    missed = 1 - counts / scene.subsamples
    radiance = found.mean + missed.unsqueeze(-1) * scene.background
    some = counts.clamp_min(1)
    depth = torch.zeros(len(counts), dtype=torch.float64).index_add_(0, hits.pixel, hits.depth.double()) / some
    return TilePixels(
        radiance.reshape(*shape, -1),
        found.variance.reshape(*shape, -1),
        (counts * samples).reshape(shape),
        (found.hint / some).reshape(shape),
        (counts / scene.subsamples).double().reshape(shape),
        depth.reshape(shape),
        time.process_time() - start,
    )


def check_tile(scene: RenderScene, rows: range, columns: range, **counts: int) -> None:
    """Refuse pixels that the picture does not have, and numbers of samples (>= 1) and passes (>= 2)."""
    for name, given, size in (("rows", rows, scene.camera.height), ("columns", columns, scene.camera.width)):
        if not isinstance(given, range) or not len(given) or given[0] < 0 or given[-1] >= size or given.step != 1:
            raise InputError(name, given, f"a range of pixels within 0 .. {size - 1}")
    for name, value in counts.items():
        least = 2 if name == "passes" else 1
        if isinstance(value, bool) or not isinstance(value, int) or value < least:
            raise InputError(name, value, f"an integer >= {least}")


def accumulate(
    scene: RenderScene, technique: Technique, hits: Hits, names: Tensor, samples: int, passes: range, seed: int
) -> Accumulated:
    """What the hits add to the pixels called `names` in these passes, one group of hits after another."""
    mean, scatter = (torch.zeros(len(names), scene.channels, dtype=torch.float64) for _ in range(2))
    hint = torch.zeros(len(names), dtype=torch.float64)
    for some in groups(hits.pixel):
        part = hits[some]
        contexts = scene.contexts(part)
        hint.index_add_(0, part.pixel, contexts.n.double())
        sampler = technique.at(part, contexts, names[part.pixel])
        first, last = int(part.pixel[0]), int(part.pixel[-1]) + 1
        own = part.pixel - first
        for k, number in enumerate(passes):
            number = pass_seed(seed, number)
            found = estimate(sampler, technique, names[part.pixel], samples, scene.camera.width, number)
            value = mean.new_zeros(last - first, scene.channels).index_add_(0, own, found) / scene.subsamples
            delta = value - mean[first:last]
            mean[first:last] += delta / (k + 1)
            scatter[first:last] += delta * (value - mean[first:last])
    return Accumulated(mean, scatter / (max(len(passes) - 1, 1) * len(passes)), hint)


def groups(pixel: Tensor, most: int = GROUP) -> list[slice]:
    """Slices of hits, at most `most` in each (or one pixel's), that do not cut a pixel; pixels are sorted."""
    _, count = torch.unique_consecutive(pixel, return_counts=True)
    slices, start, size = [], 0, 0
    for n in count.tolist():
        if size and size + n > most:
            slices.append(slice(start, start + size))
            start, size = start + size, 0
        size += n
    return [*slices, slice(start, start + size)] if size else slices


def pass_seed(seed: int, k: int) -> int:
    """The seed of pass k."""
    return (seed * 1_000_003 + k) % 2**63


@torch.no_grad()
def estimate(
    sampler: Sampler, technique: Technique, pixel: Tensor, samples: int, width: int, seed: int
) -> Tensor:  # fmt: skip
    """Estimates `[H, C]` of one pass, float64.

    Raises:
        InputError: fewer samples than the technique can do with, or an estimate that is not finite.
    """
    if samples < sampler.least:
        raise InputError("samples", samples, f"at least {sampler.least} with technique {technique.name!r}")
    found = sampler.estimate(samples, torch.Generator().manual_seed(seed)).double()
    if not bool(torch.isfinite(found.sum())):
        bad = ~torch.isfinite(found).all(-1)
        if bool(bad.any()):
            name = int(pixel[bad][0])
            where = f"technique {technique.name!r}, pixel row {name // width}, column {name % width}"
            raise InputError(f"estimate of {where}", found[bad][0].tolist(), "finite radiances")
    return found


__all__ = ["CHUNK", "GROUP", "TilePixels", "render_tile"]
