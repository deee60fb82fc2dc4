"""Paints one small image again and again, by one technique after another, against the clock.

The camera's rays are cast once: what is timed is the sampling of directions and the shading of the hits. What all
techniques share (rays, grid, hints, the BSDF's code) is made before and told apart.
"""

from __future__ import annotations

import functools
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from dsfit.errors import InputError
from dsfit.experiment.render_scene import key_of, scene_of
from dsfit.experiment.schema import Config
from dsfit.experiment.schema_render import Technique
from dsfit.race.clock import children_seconds, timed
from dsfit.render.hits import HitContext, Hits
from dsfit.render.images import RenderImage
from dsfit.render.integrator import estimate, groups
from dsfit.render.scene import RenderScene
from dsfit.render.techniques import technique as make_technique

_FEW = 16
_SHARES = (0.1, 0.25, 0.4, 0.55, 0.7, 0.85)
"""Shares of light sampling that are tried where the best one is asked for."""
_TRIAL, _TRIAL_SEED = 32, 2**40


@dataclass(frozen=True)
class Part:
    """Neighbouring pixels of the image: their hits, contexts, and the number of each hit's pixel in the image."""

    hits: Hits
    contexts: HitContext
    pixel: Tensor


@dataclass(frozen=True)
class Picture:
    """The hits of an image and what does not depend on the technique.

    Attributes:
        parts: of the image, together all of it.
        coverage, n, depth: `[H, W]`, as layers of an image.
        facts: sizes and shared seconds, for the result.
    """

    scene: RenderScene
    parts: list[Part]
    coverage: Tensor
    n: Tensor
    depth: Tensor
    facts: dict[str, Any] = field(default_factory=dict)

    def painter(self, technique: Technique) -> Painter:
        """The technique, ready to paint."""
        painter = Painter(self, technique)
        painter.warm_up()
        return painter

    def means(self, values: Tensor) -> Tensor:
        """Means `[H, W]` over the hits of every pixel; nan where there are none."""
        return _plane(self.scene, self.parts, values) / (self.coverage * self.scene.subsamples)


def _plane(scene: RenderScene, parts: list[Part], values: Tensor) -> Tensor:
    total = torch.zeros(scene.camera.height * scene.camera.width, dtype=torch.float64)
    total.index_add_(0, torch.cat([part.pixel for part in parts]), values.to(torch.float64))
    return total.reshape(scene.camera.height, scene.camera.width)


def picture_of(config: Config) -> Picture:
    """The picture of a config's scene; the last one is kept."""
    return _picture(key_of(config), _Carried(config))


@dataclass(frozen=True)
class _Carried:
    config: Config = field(compare=False)


@functools.lru_cache(maxsize=1)
def _picture(_key: Any, carried: _Carried) -> Picture:
    scene, scene_seconds = timed(lambda: scene_of(carried.config))
    parts, cast_seconds = timed(lambda: list(_parts(scene)))
    if not sum(len(part.hits) for part in parts):
        raise InputError("camera", "an empty picture", "a view in which at least one fibre is hit")
    compilers = children_seconds()
    _, first_seconds = timed(lambda: _use(scene, parts[len(parts) // 2]))
    coverage = _plane(scene, parts, torch.ones(sum(len(part.hits) for part in parts))) / scene.subsamples
    bare = Picture(scene, parts, coverage, coverage, coverage)
    n, depth = (
        bare.means(torch.cat(values))
        for values in ([part.contexts.n for part in parts], [part.hits.depth for part in parts])
    )
    facts = {
        "width": scene.camera.width,
        "height": scene.camera.height,
        "subsamples": scene.subsamples,
        "hits": sum(len(part.hits) for part in parts),
        "covered": int((coverage > 0).sum()),
        "strands": 0 if scene.strands is None else len(scene.strands),
        "mean_n": float(torch.cat([part.contexts.n for part in parts]).double().mean()),
        "backend": scene.backend,
        "shared_seconds": {
            "scene": scene_seconds,
            "rays and hints": cast_seconds,
            "code": first_seconds + children_seconds() - compilers,
        },
    }
    return Picture(scene, parts, coverage, n, torch.nan_to_num(depth), facts)


def _parts(scene: RenderScene) -> Iterator[Part]:
    hits = scene.hits(range(scene.camera.height), range(scene.camera.width))
    for some in groups(hits.pixel):
        part = hits[some]
        yield Part(part, scene.contexts(part), part.pixel)


@torch.no_grad()
def _use(scene: RenderScene, part: Part) -> None:
    """One evaluation of the integrand: tables and code that all techniques share."""
    some = slice(0, _FEW)
    omega = torch.zeros(1, len(part.contexts[some].theta_r), 2, dtype=scene.dtype)
    scene.integrand(part.hits)(omega + 0.3, part.contexts[some])


class Painter:
    """A technique that is ready for a picture.

    Attributes:
        preparation: seconds of what is done once: `prepare` (training that was recorded included), `first_use`
            (compilers, tables), `trial` (of the share of light sampling), and their sum, `seconds`.
        light: the share of light sampling.
        least: fewest samples per hit.
    """

    def __init__(self, picture: Picture, technique: Technique) -> None:
        self.picture, self.uniforms = picture, technique.uniforms
        self.fitted = technique.light == "best"
        self.light = _SHARES[0] if self.fitted else technique.light
        self.technique = make_technique(
            technique.kind, technique.options, light=self.light, uniforms=technique.uniforms, seed=1
        )
        self.preparation: dict[str, float] = {}
        self.least = 1

    def warm_up(self) -> None:
        """Prepare, and use once; all by the clock."""
        if self.preparation:
            return
        compilers = children_seconds()
        self.technique.prepare(self.picture.scene)
        prepare = self.technique.prepare_seconds
        part = self.picture.parts[len(self.picture.parts) // 2]
        with torch.no_grad():
            self.least = self.technique.at(part.hits, part.contexts, part.pixel).least
        twice = [timed(lambda: self._part(part, max(self.least, _FEW), 0))[1] for _ in range(2)]
        first = max(0.0, twice[0] - twice[1]) + children_seconds() - compilers
        trial = timed(self._fit_light)[1] if self.fitted else 0.0
        self.preparation = {"seconds": prepare + first + trial, "prepare": prepare, "first_use": first, "trial": trial}

    def _fit_light(self) -> None:
        """Take the share of light sampling whose passes over a part of the picture differ least."""
        part = self.picture.parts[len(self.picture.parts) // 2]
        spread = {share: self._spread(share, part) for share in _SHARES}
        self.light = min(_SHARES, key=lambda share: spread[share])
        self.technique.peer.share = self.light  # type: ignore[attr-defined]

    def _spread(self, share: float, part: Part) -> float:
        """Mean relative variance of pixels between two passes."""
        self.technique.peer.share = share  # type: ignore[attr-defined]
        first, names = part.pixel[0], part.pixel - part.pixel[0]
        passes = []
        for seed in range(2):
            value = self._part(part, max(self.least, _TRIAL), _TRIAL_SEED + seed)
            total = torch.zeros(int(part.pixel[-1] - first) + 1, value.shape[-1], dtype=torch.float64)
            passes.append(total.index_add_(0, names, value))
        square = ((passes[0] + passes[1]) / 2).square()
        return float(((passes[0] - passes[1]).square() / (square + 0.01 * square.mean())).mean())

    def _part(self, part: Part, samples: int, seed: int) -> Tensor:
        sampler = self.technique.at(part.hits, part.contexts, part.pixel)
        return estimate(sampler, self.technique, part.pixel, samples, self.picture.scene.camera.width, seed)

    def paint(self, samples: int, seed: int) -> tuple[Tensor, float]:
        """Radiance `[H, W, C]` in float64 from `samples` directions at every hit, and the CPU seconds that took."""
        scene, start = self.picture.scene, time.process_time()
        total = torch.zeros(scene.camera.height * scene.camera.width, scene.channels, dtype=torch.float64)
        for part in self.picture.parts:
            value = self._part(part, samples, seed)
            total.index_add_(0, part.pixel, value.expand(-1, scene.channels))
        radiance = total.reshape(scene.camera.height, scene.camera.width, -1) / scene.subsamples
        radiance += (1 - self.picture.coverage).unsqueeze(-1) * scene.background
        return radiance, time.process_time() - start

    def image(self, radiance: Tensor, variance: Tensor | None, samples: int) -> RenderImage:
        """The image with its layers."""
        picture = self.picture
        counts = picture.coverage * (picture.scene.subsamples * samples)
        return RenderImage(
            radiance, variance, counts, picture.n, None, picture.coverage, picture.depth,
            {"technique": self.technique.name, "uniforms": self.uniforms, "samplesPerHit": samples},
        )  # fmt: skip


__all__ = ["Painter", "Part", "Picture", "picture_of"]
