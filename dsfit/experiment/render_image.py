"""The image of a rendering run: its tiles put together, and what it took."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from dsfit.errors import InputError
from dsfit.experiment import about, files, provenance
from dsfit.experiment.files import number
from dsfit.experiment.render import proposal_path
from dsfit.experiment.rundir import RunDirectory
from dsfit.experiment.schema import SCHEMA_VERSION, Config
from dsfit.experiment.schema_render import RenderConfig
from dsfit.render.images import RenderImage, ToneMap, read_image, write_image, write_png

_LONG_OR_TIMED = ("config", "technique", "machine", "seconds", "wallSeconds")


def image_path(directory: RunDirectory) -> Path:
    """The image of a run."""
    return directory.path / "image.exr"


def finish(directory: RunDirectory, result: dict[str, Any], config: Config) -> dict[str, Any]:
    """Write image.exr and image.png from the tiles; returns the image's summary.

    Raises:
        InputError: radiance that is not finite (image.exr is there and shows where).
    """
    image = assemble(directory, result["cells"], config, attributes(result, config))
    data = {"dsfit.data": about.array_hash(image.radiance.numpy())}
    image = replace(image, attributes={**image.attributes, **data})
    write_image(image_path(directory), image)
    tone_map = develop(directory, config.render)
    return {**summary(image, result), "training": _training(directory), "tone_map": tone_map.describe()}


def assemble(
    directory: RunDirectory, cells: list[dict[str, Any]], config: Config, attributes: dict[str, Any]
) -> RenderImage:
    """All layers of the tiles. The time of a tile is shared out to its pixels by their samples, evenly where it has
    none."""
    height, width = config.camera.height, config.camera.width
    layers: dict[str, Tensor] = {}
    for cell in cells:
        top, left, bottom, right = cell["tile"]
        arrays = {name: torch.from_numpy(array) for name, array in directory.arrays(cell["index"]).items()}
        samples = arrays["samples"].to(torch.float64)
        share = samples / samples.sum() if float(samples.sum()) > 0 else torch.full_like(samples, 1 / samples.numel())
        arrays["time"] = share * number(cell["cpu_seconds"])
        for name, values in arrays.items():
            if name not in layers:
                layers[name] = torch.zeros(height, width, *values.shape[2:], dtype=torch.float64)
            layers[name][top:bottom, left:right] = values
    return RenderImage(**layers, attributes=attributes)


def develop(directory: RunDirectory, render: RenderConfig) -> ToneMap:
    """Write image.png from image.exr with the config's tone map; returns it with its exposure.

    Raises:
        InputError: image.exr is missing or damaged, or not finite.
    """
    image = read_image(image_path(directory))
    tone_map = ToneMap(render.exposure, render.tone_map).fixed(image.radiance, image.covered)
    source = {k: v for k, v in about.from_exr(image.attributes).items() if k not in _LONG_OR_TIMED}
    text = {
        "Software": f"dsfit {provenance.code_version()}",
        "Tone map": tone_map.describe(),
        about.KEY: about.to_text(source),
    }
    write_png(directory.path / "image.png", tone_map(image.radiance), text)
    return tone_map


def is_whole(directory: RunDirectory, render: RenderConfig) -> bool:
    """Whether a finished run still has its image; if so, the PNG is made anew, as the config may now show it
    differently."""
    try:
        develop(directory, render)
    except InputError:
        return False
    return True


def attributes(result: dict[str, Any], config: Config) -> dict[str, Any]:
    """Where an image comes from, as attributes of its file."""
    record, render = result["provenance"], config.render
    machine = record["machine"]
    source = about.about(result["name"], record, run=result["run_id"], settings=about.plain_hash(result["config"]))
    return {
        **about.exr_attributes(source),
        "dsfit.title": result["title"] or result["name"],
        "dsfit.seed": str(render.seed),
        "dsfit.technique": json.dumps(render.technique.model_dump(), sort_keys=True),
        "dsfit.subsamples": render.subsamples,
        "dsfit.samples": render.samples,
        "dsfit.passes": render.passes,
        "dsfit.machine": f"{machine['processor']}, {machine['cores']} cores, {machine['system']}",
        "dsfit.seconds": float(sum(number(cell["cpu_seconds"]) for cell in result["cells"])),
        "dsfit.wallSeconds": float(result["seconds"]),
        "dsfit.config": files.to_toml(result["config"]),
    }


def summary(image: RenderImage, result: dict[str, Any]) -> dict[str, Any]:
    """What the image is and took; standard errors are those of the random directions, at fixed places of the rays."""
    cells, covered = result["cells"], image.covered

    def total(key: str) -> float:
        return sum(number(cell[key]) for cell in cells)

    assert image.variance is not None and image.n is not None and image.coverage is not None
    variance, radiance = image.variance[covered].mean(-1), image.radiance[covered]
    relative = torch.sqrt(variance) / radiance.mean(-1)
    weight = float(image.coverage.sum())
    square = float(radiance.square().mean()) if len(radiance) else 0.0
    return {
        "width": image.width,
        "height": image.height,
        "tiles": len(cells),
        "rays": int(total("rays")),
        "hits": int(total("hits")),
        "samples": int(total("samples")),
        "covered": float(covered.double().mean()),
        "mean_n": float((image.n * image.coverage).nan_to_num().sum()) / weight if weight else math.nan,
        "cpu_seconds": total("cpu_seconds"),
        "preparation_cpu_seconds": total("preparation_cpu_seconds"),
        "wall_seconds": number(result["seconds"]),
        "peak_memory": max(int(cell["peak_memory"]) for cell in cells),
        "relative_error": float(relative[radiance.mean(-1) > 0].mean()) if square else math.nan,
        "relative_rms_error": math.sqrt(float(variance.mean()) / square) if square else math.nan,
        "backend": cells[0]["backend"],
    }


def _training(directory: RunDirectory) -> dict[str, Any] | None:
    """Facts of the proposal's training, if there was any."""
    try:
        facts = files.read_json(proposal_path(directory).with_suffix(".json"), SCHEMA_VERSION)
    except InputError:
        return None
    return {"seconds": number(facts["seconds"]), "found": facts["found"], "steps": facts["steps"]}
