"""One cell of a comparison on an image: the reference, or one technique's ladder of sample counts and its pictures."""

from __future__ import annotations

import json
import math
import traceback
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from dsfit.errors import InputError
from dsfit.experiment.about import KEY, about, array_hash, exr_attributes, plain_hash, to_text
from dsfit.experiment.compare_render_curve import climb, slope
from dsfit.experiment.compare_render_painter import Painter, picture_of
from dsfit.experiment.compare_render_reference import agreement, centred, own_error, reference_image
from dsfit.experiment.proposal_cache import cached_proposal, is_trained, with_proposal
from dsfit.experiment.rundir import RunDirectory, slug
from dsfit.experiment.schema import Config
from dsfit.experiment.schema_render import Technique
from dsfit.race.clock import Watch
from dsfit.render.images import RenderImage, ToneMap, hdr_flip, image_errors, write_image, write_png

if TYPE_CHECKING:
    from dsfit.experiment.reader import RawConfig

REFERENCE = "reference"
HEAVY = 0.5
"""Share of the relative squared error in the worst 0.1 % of the pixels from which on it counts as heavy-tailed."""
_SEED = 2**20
"""Seeds of a technique's rungs start here; those of the reference's passes are small."""


def work_of(config: Config) -> Iterator[dict[str, Any]]:
    """Identity of every cell: the reference first, then every technique."""
    for name in (REFERENCE, *(t.name for t in config.compare.techniques)):
        yield {"technique": name}


def compare_render(
    config: Config, identity: dict[str, Any], directory: RunDirectory, say: Callable[[str], None]
) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Numbers and arrays of one cell. A technique that fails says why and leaves the others alone."""
    reference, facts = _reference(config, directory, say)
    if identity["technique"] == REFERENCE:
        _write(config, directory, REFERENCE, reference, reference)
        return {"technique": REFERENCE, "reference": facts}, _arrays(reference)
    technique = next(t for t in config.compare.techniques if t.name == identity["technique"])
    data = {"technique": technique.name, **technique.model_dump(exclude={"name"})}
    watch = Watch().start()
    try:
        found, pictures = _Cell(config, reference, facts["eps"], directory, say).run(technique)
    except Exception as error:
        return {**data, "failed": f"{type(error).__name__}: {error}", "traceback": traceback.format_exc()}, {}
    return {**data, **found, "watch": watch.record(), "threads": torch.get_num_threads()}, pictures


def trained(technique: Technique, config: Config, directory: RunDirectory, say: Callable[[str], None]) -> Technique:
    """An amortised technique that is to be trained, with the file of its proposal: trained now, or for another run of
    the same fibre. The seconds of that training count as its preparation."""
    if not is_trained(technique):
        return technique
    training = dict(technique.options.get("training") or {})
    path, facts = cached_proposal(config, training, directory.path.parent, say)
    loaded = with_proposal(technique, path)
    return loaded.model_copy(update={"options": {**loaded.options, "file_seconds": float(facts["seconds"])}})


def small(config: Config) -> Config:
    """The scene as the comparison sees it: fewer pixels, its own number of rays."""
    width = config.compare.width
    height = max(1, round(width * config.camera.height / config.camera.width))
    camera = config.camera.model_copy(update={"width": width, "height": height})
    render = config.render.model_copy(update={"subsamples": config.compare.subsamples})
    return config.model_copy(update={"camera": camera, "render": render})


def _arrays(image: RenderImage) -> dict[str, np.ndarray]:
    return {name: getattr(image, name).to(torch.float32).numpy() for name in image.layers}


def _reference(
    config: Config, directory: RunDirectory, say: Callable[[str], None]
) -> tuple[RenderImage, dict[str, Any]]:
    asked = config.compare.reference
    key = config.model_dump_json(include={"geometry", "camera", "grid", "fiber", "bsdf", "light", "render"})
    key += json.dumps([asked.model_dump(), config.compare.width, config.compare.subsamples])

    def make() -> tuple[RenderImage, dict[str, Any]]:
        say("reference: preparation")
        picture = picture_of(small(config))
        brush = picture.painter(trained(asked.technique, config, directory, say))
        image, seconds = _passes(brush, asked.samples, asked.passes, 0, say, "reference")
        say("reference: check")
        other_brush = picture.painter(trained(asked.check, config, directory, say))
        other, check_seconds = _passes(other_brush, asked.check_samples, asked.check_passes, 2**19, say, "check")
        errors = image_errors(other, image)
        facts = {
            **picture.facts,
            "technique": asked.technique.model_dump(),
            "samples": asked.samples,
            "passes": asked.passes,
            "seconds": seconds,
            "eps": errors.eps,
            "own_error": own_error(image, errors.eps),
            "check": {
                **asked.check.model_dump(),
                "samples": asked.check_samples,
                "passes": asked.check_passes,
                "seconds": check_seconds,
                "error": errors.relative.root,
                **agreement(image, other),
            },
        }
        return image, facts

    image, facts = reference_image(key, directory, make)
    return image, facts


def _passes(
    painter: Painter, samples: int, passes: int, seed: int, say: Callable[[str], None], what: str
) -> tuple[RenderImage, float]:
    """Mean of independent passes, with the variance of that mean, and the seconds it took."""
    total: Tensor | float = 0.0
    squares: Tensor | float = 0.0
    spent = 0.0
    for k in range(passes):
        say(f"{what}: pass {k + 1} of {passes}")
        radiance, seconds = painter.paint(samples, seed + k)
        total, squares, spent = total + radiance, squares + radiance.square(), spent + seconds
    mean = torch.as_tensor(total) / passes
    variance = (torch.as_tensor(squares) / passes - mean.square()).clamp_min(0.0) / (passes - 1)
    return painter.image(mean, variance, samples * passes), spent


@dataclass
class _Cell:
    """A technique's measurements against the reference."""

    config: Config
    reference: RenderImage
    eps: float
    directory: RunDirectory
    say: Callable[[str], None]

    def run(self, technique: Technique) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
        """Preparation, ladder, pictures at equal time and at equal samples."""
        compare = self.config.compare
        self.say(f"{technique.name}: preparation")
        brush = picture_of(small(self.config)).painter(trained(technique, self.config, self.directory, self.say))

        floor = own_error(self.reference, self.eps)

        def measure(samples: int) -> dict[str, Any]:
            self.say(f"{technique.name}: {samples} samples per hit")
            radiance, seconds = brush.paint(samples, _SEED + samples)
            return self._row(samples, seconds, brush, radiance)

        rows = climb(
            measure, max(compare.first, brush.least), max(compare.most, brush.least), compare.seconds, floor
        )  # fmt: skip
        images: dict[str, np.ndarray] = {}
        pictures: dict[str, Any] = {}
        last = rows[-1]
        fitting = last["samples"] * compare.equal_seconds / max(last["seconds"], 1e-9)
        counts = {
            "equal_time": max(brush.least, int(fitting)),
            "equal_samples": max(brush.least, compare.equal_samples),
        }
        for k, (name, samples) in enumerate(counts.items()):
            self.say(f"{technique.name}: picture of {samples} samples per hit")
            radiance, seconds = brush.paint(samples, 2 * _SEED + k)
            pictures[name] = self._picture(name, samples, seconds, brush, radiance, technique.name)
            images[name] = radiance.to(torch.float32).numpy()
        found = {
            "prepare": brush.preparation,
            "light": brush.light,
            "rungs": rows,
            "slope": slope([r["samples"] for r in rows], [r["error"] for r in rows], floor),
            **pictures,
        }
        return {**found, **_verdict(rows)}, images

    def _row(self, samples: int, seconds: float, brush: Painter, radiance: Tensor) -> dict[str, Any]:
        errors = image_errors(brush.image(radiance, None, samples), self.reference, eps=self.eps)
        relative = errors.relative
        beyond = 1 - errors.trimmed * (1 - errors.trimmed_pixels / errors.pixels) / max(relative.measured, 1e-300)
        return {
            "samples": samples,
            "seconds": seconds,
            "rmse": errors.mse.root,
            "error": relative.root,
            "relative": asdict(relative),
            "worst_share": beyond,
            "mean": centred(radiance, self.reference),
        }

    def _picture(
        self, name: str, samples: int, seconds: float, brush: Painter, radiance: Tensor, technique: str
    ) -> dict[str, Any]:
        image = brush.image(radiance, None, samples)
        row = self._row(samples, seconds, brush, radiance)
        flip = hdr_flip(image, self.reference)
        stem = f"{name}-{slug(technique)}"
        _write(self.config, self.directory, stem, image, self.reference)
        return {**row, "flip": flip.covered, "flip_of_reference": flip.of_reference, "file": f"images/{stem}.exr"}


def _write(config: Config, directory: RunDirectory, stem: str, image: RenderImage, reference: RenderImage) -> None:
    folder = directory.path / "images"
    folder.mkdir(parents=True, exist_ok=True)
    settings, data = plain_hash(config.model_dump(exclude_none=True)), array_hash(image.radiance.numpy())
    source = about(directory.path.name, picture=stem, settings=settings, data=data)
    write_image(folder / f"{stem}.exr", replace(image, attributes={**image.attributes, **exr_attributes(source)}))
    write_png(folder / f"{stem}.png", tone_map(config, reference)(image.radiance), {KEY: to_text(source)})


def tone_map(config: Config, reference: RenderImage) -> ToneMap:
    """The tone map of all pictures of a comparison: with the exposure that suits the reference."""
    chosen = ToneMap(config.render.exposure, config.render.tone_map)
    return chosen.fixed(reference.radiance, reference.covered)


def _verdict(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """`heavy`: a few pixels make up most of the error of the largest samples, so that it is understated, and neither
    mean nor error say much; `biased`: without that, the picture as a whole is off the reference."""
    last = rows[-1]
    heavy = bool(last["worst_share"] > HEAVY)
    p = math.erfc(last["mean"]["z"] / math.sqrt(2))
    return {"heavy": heavy, "p_value": p, "biased": bool(p < 1e-6 and not heavy)}


def check(raw: RawConfig, config: Config) -> None:
    """Refuse a comparison without techniques, with two of one name, or with one that cannot be made.

    Raises:
        ConfigError: naming the key.
    """
    techniques = config.compare.techniques
    if not techniques:
        raise raw.error(("compare", "techniques"), "at least one [[compare.techniques]] table", [])
    if config.sweep.grid:
        raise raw.error(("sweep", "grid"), "nothing where kind is 'compare_render': a comparison has one scene")
    seen = {slug(REFERENCE)}
    for k, technique in enumerate(techniques):
        if slug(technique.name) in seen:
            raise raw.error(
                ("compare", "techniques", k, "name"),
                "names that differ in their letters and digits, and are not 'reference'",
            )
        seen.add(slug(technique.name))
    left, top, right, bottom = config.compare.crop
    if not (left < right and top < bottom):
        raise raw.error(("compare", "crop"), "left, top, right, bottom with left < right and top < bottom")
    from dsfit.experiment.render import check_training
    from dsfit.experiment.render_scene import check_technique

    places = [(("compare", "techniques", k), technique) for k, technique in enumerate(techniques)]
    reference = config.compare.reference
    places += [(("compare", "reference", name), getattr(reference, name)) for name in ("technique", "check")]
    for place, technique in places:
        check_technique(raw, place, technique)
        check_training(raw, place, technique, config)


__all__ = ["InputError", "REFERENCE", "check", "compare_render", "small", "tone_map", "work_of"]
