"""The chapter's figure 2, "rendered using importance sampling for M_R only": a block of blond hair, at equal time and
at equal samples, by M_R alone, by the best mix of the chapter's heuristics, by the fitted mixture, and as it should be.

Two lights, because they fail M_R for two reasons: under a lamp hardly any sample of M_R meets the lamp; under a sky
that is the same all around the light is no reason, and what is left is the tail of the weights F / p.
"""

from __future__ import annotations

import io
from typing import Annotated, Any

import numpy as np
import torch
from pydantic import Field

from dsfit.experiment.compare_render import REFERENCE, small, trained
from dsfit.experiment.compare_render_painter import picture_of
from dsfit.experiment.files import number
from dsfit.experiment.rundir import RunDirectory
from dsfit.experiment.validation import load
from dsfit.figures import Close, Data, Estimate, Exact, Experiment, Measured, Settings, Work
from dsfit.render.images import ToneMap, relative_squared_error
from experiments._figure2_weights import WEIGHTS, predict, some_pixels

SCENES = {"lamp": "render_block_figure2.toml", "sky": "render_block_blond_constant.toml"}
_M_R = '{name="M_R only", kind="single", options={proposal="M_R"}, uniforms="random"}'
_TECHNIQUES = {
    "lamp": (
        _M_R,
        '{name="best heuristic mix", kind="best_mix", options={light_sampling=false}, uniforms="random"}',
        '{name="best heuristic mix + light", kind="best_mix", uniforms="random"}',
        '{name="fitted + light", kind="guided", options=OPTIONS, uniforms="random"}',
        '{name="fitted + light, Sobol", kind="guided", options=OPTIONS}',
    ),
    "sky": (
        _M_R,
        '{name="uniform", kind="uniform", uniforms="random"}',
        '{name="best heuristic mix", kind="best_mix", uniforms="random"}',
        '{name="fitted", kind="guided", options=OPTIONS, uniforms="random"}',
        '{name="fitted, Sobol", kind="guided", options=OPTIONS}',
    ),
}
_MAP_QUALITY = 50
LOW, HIGH = 0.01, 2.0
"""Relative errors at the ends of the error maps."""
Count = Annotated[int, Field(ge=1, le=2**20)]
Seconds = Annotated[float, Field(gt=0, le=1e4)]


class Figure2(Settings):
    """`width` of the pictures in pixels with `subsamples` rays each. Techniques climb ladders of sample counts for
    `ladder_seconds`, then paint for `equal_seconds` and with `equal_samples` per hit; all by the CPU clock. The
    reference has `reference_passes` passes of `reference_samples`. The fit is trained for `training_steps`. Errors are
    predicted by quadrature with `nodes` directions at the hits of `predicted_pixels` pixels. Pictures are stored as
    JPEG of this `quality`; those at equal samples only inside the window `crop` (share of the sides around the
    centre)."""

    width: Annotated[int, Field(ge=16, le=512)] = 160
    subsamples: Annotated[int, Field(ge=1, le=64)] = 4
    ladder_seconds: Seconds = 5.0
    equal_seconds: Seconds = 3.0
    equal_samples: Count = 16
    reference_samples: Count = 192
    reference_passes: Annotated[int, Field(ge=4, le=64)] = 4
    training_steps: Count = 2400
    predicted_pixels: Count = 160
    nodes: Annotated[int, Field(ge=16, le=2**16)] = 2048
    quality: Annotated[int, Field(ge=30, le=100)] = 80
    crop: Annotated[float, Field(gt=0, le=1)] = 0.6


def compute(settings: Figure2, work: Work) -> Data:
    """Runs both comparisons, predicts their errors, and keeps pictures and maps small."""
    arrays: dict[str, np.ndarray] = {"weights": WEIGHTS}
    record: dict[str, Any] = {"equal_seconds": settings.equal_seconds, "equal_samples": settings.equal_samples,
                              "width": settings.width, "crop": settings.crop, "scenes": {}}  # fmt: skip
    for scene in SCENES:
        work.say(scene)
        overrides = _overrides(scene, settings)
        directory = work.run(SCENES[scene], overrides)
        found = _facts(directory.result())
        config = load(work.root / "configs" / SCENES[scene], overrides).config
        _pictures(arrays, scene, directory, found, ToneMap(config.render.exposure, config.render.tone_map), settings)
        work.say(f"{scene}: predictions")
        _predictions(arrays, scene, directory, found, config, settings, work)
        record["scenes"][scene] = found
    return Data(arrays, record)


def _overrides(scene: str, settings: Figure2) -> tuple[str, ...]:
    options = f"{{train=true, training={{steps={settings.training_steps}}}}}"
    techniques = ", ".join(_TECHNIQUES[scene]).replace("OPTIONS", options)
    reference = f'{{kind="amortised", options={options}, light={0.5 if scene == "lamp" else 0.25}}}'
    return (
        "camera.direction=[0.6, 0.15, 1.0]",
        f"compare.width={settings.width}",
        f"compare.subsamples={settings.subsamples}",
        f"compare.seconds={settings.ladder_seconds!r}",
        f"compare.equal_seconds={settings.equal_seconds!r}",
        f"compare.equal_samples={settings.equal_samples}",
        f"compare.techniques=[{techniques}]",
        f"compare.reference.technique={reference}",
        f"compare.reference.samples={settings.reference_samples}",
        f"compare.reference.passes={settings.reference_passes}",
        f"compare.reference.check_samples={max(1, settings.reference_samples // 8)}",
        "output.plots=false",
    )


def _facts(result: dict[str, Any]) -> dict[str, Any]:
    """The reference's facts, and every technique's."""
    facts = result["cells"][0]["reference"]
    check = facts["check"]
    found: dict[str, Any] = {
        "reference": {
            **{key: facts[key] for key in ("width", "height", "hits", "covered", "strands", "mean_n", "eps")},
            "own_error": number(facts["own_error"]),
            "samples": int(facts["samples"] * facts["passes"]),
            "check": {key: check[key] for key in ("verdict", "difference", "standard_error", "p_value")},
            "seconds": number(facts["seconds"]),
        },
        "techniques": [cell["technique"] for cell in result["cells"][1:]],
        "of": {},
    }
    for cell in result["cells"][1:]:
        if "failed" in cell:
            raise RuntimeError(f"{cell['technique']}: {cell['failed']}")
        rungs = {key: [number(rung[key]) for rung in cell["rungs"]] for key in ("samples", "seconds", "error")}
        found["of"][cell["technique"]] = {
            "uniforms": cell["uniforms"], "heavy": cell["heavy"], "biased": cell["biased"], "index": cell["index"],
            "prepare_seconds": number(cell["prepare"]["seconds"]), "rungs": rungs,
            **{which: _picture_facts(cell[which]) for which in ("equal_time", "equal_samples")},
        }  # fmt: skip
    return found


def _picture_facts(row: dict[str, Any]) -> dict[str, Any]:
    """Numbers of one picture; `error_error` is the standard error of its relative error, over pixels."""
    error, spread = number(row["error"]), number(row["relative"]["standard_error"])
    return {
        "samples": row["samples"], "seconds": number(row["seconds"]), "error": error,
        "error_error": spread / (2 * error) if error > 0 else 0.0, "rmse": number(row["rmse"]),
        "flip": number(row["flip"]), "mean": number(row["mean"]["difference"]),
        "mean_error": number(row["mean"]["standard_error"]), "worst_share": number(row["worst_share"]),
    }  # fmt: skip


def _pictures(
    arrays: dict[str, np.ndarray], scene: str, directory: RunDirectory, found: dict[str, Any], tone: ToneMap,
    settings: Figure2,
) -> None:  # fmt: skip
    """JPEG files of the pictures with random points, tone-mapped alike, and of their error maps (log error)."""
    stored = directory.arrays(0)
    reference, covered = torch.from_numpy(stored["radiance"]), torch.from_numpy(stored["coverage"]) > 0
    tone = tone.fixed(reference, covered)
    arrays[f"{scene}.{REFERENCE}"] = _jpeg(tone(reference), settings.quality)
    for name in found["techniques"]:
        if found["of"][name]["uniforms"] != "random":  # in the table alone
            continue
        images = directory.arrays(found["of"][name]["index"])
        for which in ("equal_time", "equal_samples"):
            image = torch.from_numpy(images[which])
            error = relative_squared_error(image, reference, number(found["reference"]["eps"])).sqrt()
            shade = torch.log(error.clamp(LOW, HIGH) / LOW) / np.log(HIGH / LOW) * covered
            window = _window(image.shape, 1.0 if which == "equal_time" else settings.crop)
            arrays[f"{scene}.{name}.{which}"] = _jpeg(tone(image)[window], settings.quality)
            arrays[f"{scene}.{name}.{which}.map"] = _jpeg(shade[..., None][window], _MAP_QUALITY)


def _window(shape: torch.Size, part: float) -> tuple[slice, slice]:
    """The window of this share of the sides around the centre."""
    sides = []
    for size in shape[:2]:
        inside = max(1, round(part * size))
        sides.append(slice((size - inside) // 2, (size - inside) // 2 + inside))
    return sides[0], sides[1]


def _jpeg(display: torch.Tensor, quality: int) -> np.ndarray:
    """A JPEG file, as bytes, of display values in [0, 1]: noise makes it ten times as small as anything lossless."""
    from PIL import Image

    pixels = (display.double().clamp(0, 1) * 255).round().to(torch.uint8).numpy()
    buffer = io.BytesIO()
    Image.fromarray(pixels if pixels.shape[2] == 3 else pixels[..., 0]).save(
        buffer, "jpeg", quality=quality, subsampling=0, optimize=True
    )
    return np.frombuffer(buffer.getvalue(), dtype=np.uint8)


def _predictions(
    arrays: dict[str, np.ndarray], scene: str, directory: RunDirectory, found: dict[str, Any], config: Any,
    settings: Figure2, work: Work,
) -> None:  # fmt: skip
    """Predicted errors of both pictures by techniques with random points, and the tails of their weights."""
    picture = picture_of(small(config))
    parts = some_pixels(picture, settings.predicted_pixels, seed=1)
    radiance = torch.from_numpy(directory.arrays(0)["radiance"])
    eps = number(found["reference"]["eps"])
    for technique in config.compare.techniques:
        if technique.uniforms != "random":
            continue
        facts = found["of"][technique.name]
        painter = picture.painter(trained(technique, config, directory, work.say))
        prediction = None
        for which in ("equal_time", "equal_samples"):
            if prediction is None or technique.kind == "guided":  # which draws few samples from another law than many
                samples = int(facts[which]["samples"])
                prediction = predict(painter, parts, samples, settings.nodes, radiance, eps)
            if prediction is None:
                continue
            predicted, spread = prediction.error(int(facts[which]["samples"]))
            facts[which] |= {"predicted": predicted, "predicted_error": spread}
            arrays[f"{scene}.{technique.name}.survival"] = prediction.survival.astype(np.float32)
            arrays[f"{scene}.{technique.name}.moment"] = prediction.moment.astype(np.float32)


EXPERIMENT = Experiment(
    title="M_R only (the chapter's figure 2)",
    shows="A block of blond hair under a lamp and under a sky by M_R only, by uniform directions, by the best "
    "heuristic mix and by the fitted mixture, at equal time and at equal samples, with maps of the error beside the "
    "converged reference; errors measured and predicted, and the tail of the weights that tells why.",
    settings=Figure2,
    compute=compute,
    minutes=4.0,
    needs=("embreex", "PIL"),
    reproduces={
        "weights": Close(1e-12),
        "*.survival": Close(0.5, 1e-6),
        "*.moment": Close(0.0, 0.05),
        "lamp.*": Measured(),  # pictures: noise, in as many samples as fitted into the time
        "sky.*": Measured(),
        "scenes.*.rungs.*": Measured(),
        "*.seconds": Measured(),
        "*.prepare_seconds": Measured(),
        "scenes.*.reference.check.verdict": Exact(),
        "scenes.*.reference.check.*": Measured(),
        "scenes.*.reference.own_error": Close(0.2),
        "scenes.*.reference.eps": Close(0.02),
        "scenes.*.reference.*": Close(1e-3),  # rays on edges
        "scenes.*.equal_time.*": Measured(),
        "scenes.*.heavy": Measured(),
        "scenes.*.equal_samples.mean": Estimate("scenes.*.equal_samples.mean_error", most=1e9),
        "scenes.*.equal_samples.predicted": Close(0.1),
        "scenes.*.equal_samples.samples": Close(1e-12),
        "scenes.*.equal_samples.*_error": Measured(),
        "scenes.*.equal_samples.worst_share": Measured(),
        "scenes.sky.of.M_R only.equal_samples.*": Measured(),  # decided by a few pixels
        "scenes.*.equal_samples.*": Close(0.15),  # the fit's training and the mix's shares differ in their last digits
    },
    small=("width=24", "ladder_seconds=0.2", "equal_seconds=0.1", "equal_samples=4", "reference_samples=8",
           "training_steps=20", "predicted_pixels=8", "nodes=256"),
)  # fmt: skip
