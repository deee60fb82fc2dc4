"""Amortised proposals that runs of the same fibre share: trained once, kept beside the run directories."""

from __future__ import annotations

import dataclasses
import hashlib
import json
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dsfit.errors import InputError
from dsfit.experiment import build, files
from dsfit.experiment.amortised_method import loaded
from dsfit.experiment.provenance import sources_hash
from dsfit.experiment.schema import SCHEMA_VERSION
from dsfit.experiment.store import save_proposal
from dsfit.race.clock import timed

if TYPE_CHECKING:
    from dsfit.bsdf import DualScattering
    from dsfit.experiment.schema import Config
    from dsfit.experiment.schema_render import Technique

FOLDER = "proposals-cache"
TRAINED = ("amortised", "guided")
"""Techniques of a rendering that draw from an amortised proposal."""
_TRAINING_CODE = ("bsdf", "fit", "proposals", "scene")
"""Packages that training runs through: a change to others leaves the cache as it is."""


def cache_key(bsdf: DualScattering, training: dict[str, Any]) -> str:
    """Hash of the BSDF, the options of the training, and the code that does it."""
    fiber = {name: value.tolist() for name, value in bsdf.fiber.parameters().items()}
    convention = dataclasses.asdict(bsdf.convention)
    what = [fiber, float(bsdf.d_f), float(bsdf.d_b), bsdf.model, convention, bsdf.precision, training]
    text = json.dumps([what, sources_hash(_TRAINING_CODE)], sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def cached_proposal(
    config: Config, training: dict[str, Any], folder: str | Path, say: Callable[[str], None]
) -> tuple[Path, dict[str, Any]]:
    """File of the amortised proposal of the config's fibre, from `folder`/proposals-cache or trained now, and facts of
    its training.

    Whole or not at all: an interrupted training leaves nothing, a damaged file is trained again, and two processes that
    train the same proposal at once write the same file one after the other.

    Args:
        training: keyword arguments of `dsfit.amortise`.
        folder: of run directories.

    Returns:
        The file, for `dsfit.load_proposal`, and `seconds` (CPU seconds of the training, whenever it was),
        `wall_seconds` of its parts, `steps`, `contexts`, and `found`: whether it was there already.

    Raises:
        InputError: an option that `dsfit.amortise` refuses.
    """
    bsdf = build.bsdf(config)
    path = Path(folder) / FOLDER / f"{cache_key(bsdf, training)}.npz"
    try:
        loaded(str(path), bsdf)
        return path, {**_facts(path), "found": True}
    except InputError:
        pass
    from dsfit.fit.amortise import amortise

    say("training the proposal")
    found, seconds = timed(lambda: amortise(bsdf, **training))
    spent = {"seconds": seconds, "wall_seconds": found.seconds}
    facts = {**spent, "steps": found.steps, "contexts": found.contexts}
    save_proposal(path, found.proposal)
    files.write_json(path.with_suffix(".json"), {"schema_version": SCHEMA_VERSION, **facts})
    return path, {**facts, "found": False}


def _facts(path: Path) -> dict[str, Any]:
    facts = files.read_json(path.with_suffix(".json"), SCHEMA_VERSION)
    return {key: value for key, value in facts.items() if key != "schema_version"}


def is_trained(technique: Technique) -> bool:
    """Whether a technique asks for a training before the first tile."""
    return technique.kind in TRAINED and bool(technique.options.get("train")) and not technique.options.get("file")


def with_proposal(technique: Technique, path: Path) -> Technique:
    """The technique with its trained proposal from a file; what the training took is counted elsewhere."""
    options = {key: value for key, value in technique.options.items() if key not in ("train", "training")}
    return technique.model_copy(update={"options": {**options, "file": str(path)}})
