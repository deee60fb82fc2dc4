"""Error against run time in images: techniques on one small image of every scene of hair."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from dsfit.experiment.compare_render_summary import reference_of, rows, samples_light
from dsfit.experiment.files import number
from dsfit.experiment.reader import read
from dsfit.figures import Close, Data, Estimate, Experiment, Measured, Settings, Work
from dsfit.render.images import ToneMap, relative_squared_error
from experiments._image_times import pack_curves, pack_times

_LOW = 1e-3
"""Relative error that an error map shows as 0; 10 is shown as 255."""


class ImageErrorTime(Settings):
    """Scenes are `configs/render_SCENE.toml`. Every technique gets `seconds` of CPU time on an image `scale` times as
    wide as the scene's own comparison, against a reference of `reference_samples` directions per hit in each of four
    passes; pictures are compared after `equal_seconds` and with `equal_samples` directions per hit. `trained` says
    whether amortised proposals are trained (once a fibre; else they are the closed forms that training starts from). Of
    `pictures`, crops of `crop` pixels are kept."""

    scenes: list[str]
    scale: float
    seconds: float
    reference_samples: int
    equal_seconds: float
    equal_samples: int
    trained: bool
    pictures: list[str]
    crop: int
    seed: int


def compute(settings: ImageErrorTime, work: Work) -> Data:
    """Compares techniques scene by scene.

    Arrays of each SCENE, in the order of its techniques: `SCENE.curves` `[techniques, rungs, fields]` and
    `SCENE.times` `[techniques, targets, fields, 2]` as in `experiments._image_times`; `SCENE.prepare`, seconds;
    `SCENE.error` and `SCENE.standard_error`, relative error with equal samples per hit and its standard error over
    pixels; `SCENE.own_error`, that of the reference; `SCENE.mean` and `SCENE.mean_error` `[channels]`, the reference's
    mean radiance over covered pixels and its standard error; `SCENE.reference` and `SCENE.picture.K`, crops after tone
    mapping, and `SCENE.map.K`, their relative errors, logarithmic from 0.001 to 10 (uint8).
    """
    arrays: dict[str, np.ndarray] = {}
    record: dict[str, Any] = {"equal_seconds": settings.equal_seconds, "equal_samples": settings.equal_samples}
    scenes = []
    for scene in settings.scenes:
        work.say(scene)
        config = f"render_{scene}.toml"
        directory = work.run(config, _overrides(settings, work, config))
        result = directory.result()
        cells = [cell for cell in result["cells"][1:] if "rungs" in cell]
        layers = directory.arrays(0)
        found = _numbers(cells, result, layers)
        shown = [cell for cell in cells if cell["technique"] in settings.pictures]
        images = {cell["technique"]: directory.arrays(cell["index"])["equal_time"] for cell in shown}
        found |= _pictures(images, layers, result, settings.crop)
        arrays |= {f"{scene}.{key}": values for key, values in found.items()}
        scenes.append({"name": scene, **_facts(cells, shown, result)})
    return Data(arrays, {**record, "scenes": scenes})


def _overrides(settings: ImageErrorTime, work: Work, config: str) -> tuple[str, ...]:
    """Changes of a scene's config; training is an option of each technique."""
    compare = read(work.root / "configs" / config).data["compare"]
    changes = [
        f"compare.width={max(8, round(settings.scale * compare['width']))}",
        f"compare.seconds={settings.seconds}",
        f"compare.reference.samples={settings.reference_samples}",
        f"compare.equal_seconds={settings.equal_seconds}",
        f"compare.equal_samples={settings.equal_samples}",
        f"render.seed={settings.seed}",
    ]
    if not settings.trained:
        places = {f"compare.techniques.{k}": one for k, one in enumerate(compare["techniques"])}
        places["compare.reference.technique"] = compare["reference"]["technique"]
        changes += [
            f"{place}.options.train=false" for place, one in places.items() if "train" in one.get("options", {})
        ]
    return tuple(changes)


def _facts(cells: list[dict[str, Any]], shown: list[dict[str, Any]], result: dict[str, Any]) -> dict[str, Any]:
    reference = reference_of(result)
    techniques = [
        {
            "name": cell["technique"],
            "kind": cell["kind"],
            "sobol": cell["uniforms"] == "sobol",
            "samples_light": samples_light(cell),
            "biased": cell["biased"],
        }
        for cell in cells
    ]
    return {
        "title": result["title"],
        "targets": [number(target) for target in result["config"]["compare"]["targets"]],
        "techniques": techniques,
        "check": reference["check"]["verdict"],
        "pixels": [reference["width"], reference["height"]],
        "hits": reference["hits"],
        "pictures": [cell["technique"] for cell in shown],
        "at_equal_time": [
            {"error": cell["equal_time"]["error"], "samples": cell["equal_time"]["samples"]} for cell in shown
        ],
    }


def _numbers(
    cells: list[dict[str, Any]], result: dict[str, Any], layers: dict[str, np.ndarray]
) -> dict[str, np.ndarray]:
    equal = [cell["equal_samples"] for cell in cells]
    error = np.array([number(one["error"]) for one in equal])
    square = np.array([number(one["relative"]["standard_error"]) for one in equal])
    covered = layers["coverage"] > 0
    summary = [row for row in rows(result) if not row["failed"]]
    return {
        "curves": pack_curves(cells),
        "times": pack_times(summary, result["config"]["compare"]["targets"]),
        "prepare": np.array([number(cell["prepare"]["seconds"]) for cell in cells]),
        "heavy": np.array([bool(cell["heavy"]) for cell in cells]),
        "error": error,
        "standard_error": square / np.maximum(2 * error, 1e-300),
        "own_error": np.array(number(reference_of(result)["own_error"])),
        "mean": layers["radiance"][covered].mean(0, dtype=np.float64),
        "mean_error": np.sqrt(layers["variance"][covered].sum(0, dtype=np.float64)) / covered.sum(),
    }


def _pictures(
    images: dict[str, np.ndarray], layers: dict[str, np.ndarray], result: dict[str, Any], crop: int
) -> dict[str, np.ndarray]:
    """Crops of the pictures, of their errors, and of the reference."""
    radiance = torch.from_numpy(layers["radiance"])
    render = result["config"]["render"]
    tone = ToneMap(render.get("exposure"), render["tone_map"])
    tone = tone.fixed(radiance, torch.from_numpy(layers["coverage"]) > 0)
    window = _window(radiance.shape, [number(x) for x in result["config"]["compare"]["crop"]], crop)
    eps = number(reference_of(result)["eps"])
    found = {"reference": _bytes(tone(radiance[window]))}
    for k, image in enumerate(map(torch.from_numpy, images.values())):
        error = relative_squared_error(image, radiance, eps).sqrt()[window]
        found[f"picture.{k}"] = _bytes(tone(image[window]))
        found[f"map.{k}"] = _bytes(torch.log10(error.clamp(_LOW, 10.0) / _LOW) / 4)
    return found


def _window(shape: torch.Size, shares: list[float], crop: int) -> tuple[slice, slice]:
    """At most `crop` pixels each way around the middle of the scene's own crop."""
    found = []
    for size, low, high in ((shape[0], shares[1], shares[3]), (shape[1], shares[0], shares[2])):
        side = min(crop, size)
        first = min(max(round((low + high) / 2 * size - side / 2), 0), size - side)
        found.append(slice(first, first + side))
    return found[0], found[1]


def _bytes(values: torch.Tensor) -> np.ndarray:
    return (values.clamp(0, 1) * 255).round().to(torch.uint8).numpy()


EXPERIMENT = Experiment(
    title="Error against run time in images",
    shows="Relative error of 20 techniques on six scenes of hair against CPU time, pictures of equal time, and how "
    "many times as long others take to equal error.",
    settings=ImageErrorTime,
    compute=compute,
    minutes=33.0,
    reproduces={
        "scenes.*.at_equal_time.*": Measured(),
        "*.error": Estimate("*.standard_error"),
        "*.mean": Estimate("*.mean_error"),
        "*.own_error": Close(0.3),
        "*.reference": Close(0.0, 64),  # noise of the reference, in levels of 256
        # how far a technique gets, and its pictures after equal time
        "*.curves": Measured(),
        "*.times": Measured(),
        "*.prepare": Measured(),
        "*.heavy": Measured(),
        "*.picture.*": Measured(),
        "*.map.*": Measured(),
    },
    small=(
        'scenes=["block_blond_constant"]',
        "scale=0.3",
        "seconds=0.05",
        "reference_samples=16",
        "equal_seconds=0.05",
        "trained=false",
    ),
)
