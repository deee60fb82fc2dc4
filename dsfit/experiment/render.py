"""`dsfit render`: the tiles of a picture are the cells of a run, which become one image at the end."""

from __future__ import annotations

import functools
import hashlib
import inspect
import json
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from dsfit.errors import InputError
from dsfit.experiment import build, files
from dsfit.experiment.amortised_method import loaded
from dsfit.experiment.proposal_cache import cached_proposal, is_trained, with_proposal
from dsfit.experiment.render_scene import key_of, scene_of
from dsfit.experiment.rundir import RunDirectory
from dsfit.experiment.schema import SCHEMA_VERSION, Config
from dsfit.race.clock import children_seconds

if TYPE_CHECKING:
    from dsfit.experiment.reader import RawConfig
    from dsfit.experiment.schema_render import Technique as TechniqueConfig
    from dsfit.render.techniques import Technique

_LAYERS = ("radiance", "variance", "samples", "n", "coverage", "depth")
MAX_TILES = 100_000


def work_of(config: Config) -> Iterator[dict[str, Any]]:
    """Identity of every cell: the tile's first row and column, and those after its last."""
    step, height, width = config.render.tile, config.camera.height, config.camera.width
    for top in range(0, height, step):
        for left in range(0, width, step):
            yield {"tile": [top, left, min(top + step, height), min(left + step, width)]}


def proposal_path(directory: RunDirectory) -> Path:
    """The run's own copy of the proposal that was trained for it."""
    return directory.path / "proposals" / "amortised.npz"


def prepare(directory: RunDirectory, config: Config, say: Callable[[str], None]) -> None:
    """Train what the technique asks for, once for all tiles, or find it: in the run directory, or among those of the
    same fibre beside it. In one thread, so that the proposal does not depend on the machine's cores."""
    technique = config.render.technique
    if not is_trained(technique):
        return
    path = proposal_path(directory)
    try:
        loaded(str(path), build.bsdf(config))
        files.read_json(path.with_suffix(".json"), SCHEMA_VERSION)
        return
    except InputError:
        pass
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        training = dict(technique.options.get("training") or {})
        found, facts = cached_proposal(config, training, directory.path.parent, say)
    finally:
        torch.set_num_threads(threads)
    files.write_bytes(path, found.read_bytes())
    files.write_json(path.with_suffix(".json"), {"schema_version": SCHEMA_VERSION, **facts})


@dataclass(frozen=True)
class _Key:
    """A config and a run directory that equal others if they render alike."""

    config: Config
    directory: RunDirectory
    key: tuple[Any, ...]

    def __hash__(self) -> int:
        return hash(self.key)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Key) and self.key == other.key


@functools.lru_cache(maxsize=1)
def _technique(asked: _Key) -> Technique:
    """The technique; the last one is kept, so that a process prepares once for all of its tiles."""
    from dsfit.render.techniques import technique

    chosen = asked.config.render.technique
    if is_trained(chosen):
        chosen = with_proposal(chosen, proposal_path(asked.directory))
    seed = asked.config.render.seed
    return technique(chosen.kind, chosen.options, light=chosen.light, uniforms=chosen.uniforms, seed=seed)


def render(
    config: Config, identity: dict[str, Any], directory: RunDirectory, say: Callable[[str], None]
) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Numbers and arrays of one tile."""
    from dsfit.render.adaptive import render_adaptive
    from dsfit.render.integrator import render_tile

    clock = _Clock()
    say("scene")
    scene = scene_of(config)
    asked = config.render
    technique = _technique(_Key(config, directory, (key_of(config), asked.seed, *_technique_key(config, directory))))
    technique.prepare(scene)
    prepared = clock.read()
    top, left, bottom, right = identity["tile"]
    say(f"row {top}, column {left}")
    window = range(top, bottom), range(left, right)
    effort = {"samples": asked.samples, "passes": asked.passes, "seed": direction_seed(config)}
    if asked.pilot is None:
        tile = render_tile(scene, technique, *window, **effort)
    else:
        tile = render_adaptive(scene, technique, *window, pilot=asked.pilot, **effort)
    data = {
        "tile": identity["tile"],
        "rays": tile.coverage.numel() * asked.subsamples,
        "hits": round(float(tile.coverage.sum()) * asked.subsamples),
        "samples": int(tile.samples.sum()),
        "cpu_seconds": clock.read() - prepared,
        "preparation_cpu_seconds": prepared,
        "backend": scene.backend,
        "peak_memory": peak_memory(),
    }
    return data, {name: getattr(tile, name).numpy() for name in _LAYERS}


def _technique_key(config: Config, directory: RunDirectory) -> tuple[Any, ...]:
    """Equal for equal techniques, as long as the proposal that was trained for them does not change."""
    technique = config.render.technique
    trained = proposal_path(directory) if is_trained(technique) else None
    return technique.model_dump_json(), trained and (str(trained.resolve()), trained.stat().st_mtime_ns)


def direction_seed(config: Config) -> int:
    """Seed of the random directions: other samples, passes or techniques get independent ones, at the same places of
    the rays, so that the noise of an image and of its reference has nothing in common."""
    asked = config.render
    effort = [asked.seed, asked.samples, asked.passes, asked.pilot]
    text = json.dumps([*effort, asked.technique.model_dump()], sort_keys=True)
    return int.from_bytes(hashlib.sha256(text.encode()).digest()[:4], "little")


class _Clock:
    """CPU seconds of this process and of the compilers that it waited for."""

    def __init__(self) -> None:
        self._start = self._now()

    def _now(self) -> float:
        return time.process_time() + children_seconds()

    def read(self) -> float:
        """Since it was made."""
        return self._now() - self._start


def peak_memory() -> int:
    """Most bytes of memory that this process has had (its maximal resident set); 0 where the system does not tell."""
    try:
        import resource
    except ImportError:  # pragma: no cover (Windows)
        return 0
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)


def check(raw: RawConfig, config: Config) -> None:
    """Refuse what does not make one picture.

    Raises:
        ConfigError: naming the key.
    """
    if config.sweep.grid:
        raise raw.error(("sweep", "grid"), "nothing where kind is 'render': a run makes one picture")
    channels = max(build.bsdf(config).channels, build.light(config).channels)
    if channels not in (1, 3):
        raise raw.error(("fiber", "sigma_a"), f"1 or 3 channels in a rendering (fibre and light have {channels})")
    if sum(1 for _ in work_of(config)) > MAX_TILES:
        raise raw.error(("render", "tile"), f"a size that makes at most {MAX_TILES} tiles")
    check_training(raw, ("render", "technique"), config.render.technique, config)


def check_training(raw: RawConfig, key: tuple[str | int, ...], technique: TechniqueConfig, config: Config) -> None:
    """Refuse a training that `dsfit.amortise` would refuse when it is due.

    Raises:
        ConfigError: naming the key.
    """
    if not is_trained(technique):
        return
    if not build.fiber(config.fiber, torch.float64).is_round:
        raise raw.error(("fiber", "eccentricity"), "1 (a round fibre), or a technique that is not trained")
    from dsfit.fit.amortise import amortise

    known = [name for name in inspect.signature(amortise).parameters if name not in ("bsdf", "stream", "start")]
    where, training = (*key, "options", "training"), technique.options.get("training") or {}
    if not isinstance(training, dict):
        raise raw.error(where, "a table with the keys " + ", ".join(known), training)
    for name, value in training.items():
        if name not in known:
            raise raw.error((*where, name), "one of the keys " + ", ".join(known), value)
