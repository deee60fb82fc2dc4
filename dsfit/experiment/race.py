"""One cell of a race: a peer over the stream of contexts, or at the contexts of the config."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from dsfit.context import Context
from dsfit.errors import InputError
from dsfit.experiment import build, files
from dsfit.experiment.race_summary import heavy_tailed
from dsfit.experiment.rundir import RunDirectory
from dsfit.experiment.schema import Config
from dsfit.experiment.schema_race import RacePeer
from dsfit.race import registry
from dsfit.race.clock import Ready, Watch, make_ready
from dsfit.race.context_race import ContextPlan, race_context
from dsfit.race.implementation import make_integrand
from dsfit.race.peer import Problem
from dsfit.race.references import StreamReference
from dsfit.race.stream_race import StreamPlan, race_stream
from dsfit.scene.integrand import Integrand
from dsfit.streams import ContextStream

if TYPE_CHECKING:
    from dsfit.experiment.reader import RawConfig
    from dsfit.quality import Nodes

GROUPS = ("stream", "contexts")
LEVEL = 1e-6
"""A peer fails where estimates are centred on the truth with a smaller probability than this, in either group."""
_CHECKED = 4
_REFERENCE_ERROR = 1e-4
_NODES_RTOL = 1e-4
_ALLOWANCE = {torch.float32: 1e-4, torch.float64: 2e-5}
_FIRST_USE = 16


def work_of(config: Config) -> Iterator[dict[str, Any]]:
    """Identity of every cell: peer and group of contexts."""
    for peer in config.race.peers:
        for group in GROUPS:
            yield {"peer": peer.name, "group": group}


def race(
    config: Config, identity: dict[str, Any], directory: RunDirectory, say: Callable[[str], None]
) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Numbers and arrays of one cell; a peer whose packages are not installed says so and runs nothing."""
    peer = next(p for p in config.race.peers if p.name == identity["peer"])
    data: dict[str, Any] = {"peer": peer.name, "kind": peer.kind, "uniforms": peer.uniforms, "group": identity["group"]}
    if absent := registry.missing(peer.kind):
        return {**data, "skipped": f"not installed: {', '.join(absent)}"}, {}
    say("references")
    course = _course(_key(config), config, directory)
    data.update(course.facts)
    say(f"{peer.name}: preparation")
    watch = Watch().start()
    ready = _ready(_key(config) + peer.model_dump_json(), course, peer)
    data["prepare"] = {k: getattr(ready, k) for k in ("seconds", "prepare", "recorded", "first_use")}
    generator = torch.Generator().manual_seed(_seed(config, peer.name, identity["group"]))
    say(f"{peer.name}: {identity['group']}")
    if identity["group"] == "stream":
        found, arrays = _stream(course, ready, generator)
    else:
        found, arrays = _contexts(course, ready, generator), {}
    data.update(found, watch=watch.record(), threads=torch.get_num_threads())
    return {**data, **_verdict(found)}, arrays


@dataclass
class Course:
    """What all peers of a race share: the integrand, contexts and their integrals.

    Attributes:
        exact: the integrand in eager float64 that references come from.
        integrand: what peers call; None in an eager race, where each peer has its own copy, so that tables cached
            by one are not a present to the next.
        facts: of the implementation and the references.
        contexts, truth: the stream `[N]`, float64, and its integrals `[N, C]`.
        single: label, context `[1]`, integral `[C]` and quadrature nodes of each of the config's contexts.
    """

    config: Config
    exact: Integrand
    integrand: Any
    facts: dict[str, Any]
    contexts: Context
    truth: Tensor
    single: list[tuple[dict[str, Any], Context, Tensor, Nodes]] = field(default_factory=list)

    @property
    def dtype(self) -> torch.dtype:
        """Of contexts and values."""
        return getattr(torch, self.config.estimate.dtype)

    @property
    def allowance(self) -> float:
        """What the references and the arithmetic may be off by, relative to the integral."""
        return _ALLOWANCE[self.dtype]


def stream_of(config: Config) -> ContextStream:
    """The stream that `[race.stream]` describes."""
    s = config.race.stream
    return ContextStream(s.theta, math.radians(s.theta_max_deg), s.direct, s.n_mean, s.n_max, s.rule)


def _key(config: Config) -> str:
    scene = config.model_dump(include={"fiber", "bsdf", "light", "scattering", "contexts", "estimate"})
    scene["race"] = config.race.model_dump(exclude={"peers", "budgets"})
    return json.dumps(scene, sort_keys=True)


def _seed(config: Config, *names: str) -> int:
    text = json.dumps([config.estimate.seed, *names])
    return int.from_bytes(hashlib.sha256(text.encode()).digest()[:6], "little")


_COURSES: dict[str, Course] = {}


def _course(key: str, config: Config, directory: RunDirectory) -> Course:
    """The course of this config; made once per process, its stream's integrals once per run directory."""
    if key in _COURSES:
        return _COURSES[key]
    exact, dtype = build.integrand(config), getattr(torch, config.estimate.dtype)
    _use(exact, torch.float64)
    integrand, facts = make_integrand(exact, config.race.implementation, dtype)
    generator = torch.Generator().manual_seed(_seed(config, "stream"))
    contexts = stream_of(config).draw(config.race.stream.count, generator).to(dtype).to(torch.float64)
    truth, error = _stream_truth(key, exact, contexts, directory)
    course = Course(
        config, exact, None if integrand is exact else integrand, {**facts, "reference_error": error}, contexts, truth
    )
    course.single = list(_single(config, exact, dtype))
    _COURSES.clear()
    _COURSES[key] = course
    return course


def _stream_truth(key: str, exact: Integrand, contexts: Context, directory: RunDirectory) -> tuple[Tensor, float]:
    """Integrals of the stream, from the run directory or computed and checked against `dsfit.reference`."""
    path = directory.path / "cells" / f"references-{hashlib.sha256(key.encode()).hexdigest()[:12]}.npz"
    try:
        stored = files.read_arrays(path)
        return torch.from_numpy(stored["truth"]), float(stored["error"])
    except (InputError, KeyError):
        pass
    reference = StreamReference(exact)
    error = reference.check(contexts[: min(_CHECKED, len(contexts))])
    if not error <= _REFERENCE_ERROR:
        raise InputError("race.stream", error, f"references that agree to {_REFERENCE_ERROR:g}")
    truth = reference(contexts)
    files.write_arrays(path, {"truth": truth.numpy(), "error": np.array(error)})
    return truth, error


def _single(
    config: Config, exact: Integrand, dtype: torch.dtype
) -> Iterator[tuple[dict[str, Any], Context, Tensor, Nodes]]:
    from dsfit.quality import quadrature_nodes, reference

    for values in build.context_values(config.contexts):
        context = build.context(config, values).to(dtype).to(torch.float64)
        truth = reference(exact, context, rtol=config.estimate.rtol)
        yield values, context.reshape(1), truth.value, quadrature_nodes(exact, context, rtol=_NODES_RTOL)


def _use(integrand: Integrand, dtype: torch.dtype) -> None:
    """Evaluate once, so that tables of the BSDF itself, which all peers need, are there."""
    omega = torch.tensor([[0.3, 2.0], [-0.2, 0.5]], dtype=dtype)
    with torch.no_grad():
        integrand(omega, Context(0.1, 0.0, 2.0, 0.5).to(dtype))


_READY: dict[str, Ready] = {}


def _ready(key: str, course: Course, peer: RacePeer) -> Ready:
    """The prepared peer; the last one is kept, so that its two groups prepare once."""
    if key not in _READY:
        _READY.clear()
        own = Integrand(course.exact.bsdf.replace(), course.exact.light, course.exact.scattering)
        _use(own, torch.float64)
        _use(own, course.dtype)
        integrand = own if course.integrand is None else course.integrand
        seed = _seed(course.config, "prepare") % 2**31
        problem = Problem(integrand, stream_of(course.config), course.dtype, peer.uniforms, seed, own)
        generator = torch.Generator().manual_seed(seed)
        maker = registry.make(peer.kind, peer.options)
        _READY[key] = make_ready(maker, problem, _first_uses(course, maker.per_context), generator)
    return _READY[key]


def _first_uses(course: Course, per_context: bool) -> list[Context]:
    """Contexts that a peer is used at before the race: the first of the stream, together, and of those that are lit,
    and that are not, one by one, because code may be made for each kind."""
    contexts = course.contexts.to(course.dtype)
    if per_context:
        return [contexts[:1]]
    alone = [torch.nonzero(kind)[:1, 0] for kind in (contexts.v == 1, contexts.v == 0)]
    return [contexts[: min(_FIRST_USE, len(contexts))], *(contexts[k] for k in alone if len(k))]


def _stream(
    course: Course, ready: Ready, generator: torch.Generator
) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    s = course.config.race.stream
    plan = StreamPlan(seconds=s.seconds, batch=s.batch, fewest=min(s.fewest, s.count))
    contexts = course.contexts.to(course.dtype)
    found, errors = race_stream(ready, contexts, course.truth, plan, generator, allowance=course.allowance)
    return {"stream": found}, {"errors": errors.to(torch.float32).numpy()}


def _contexts(course: Course, ready: Ready, generator: torch.Generator) -> dict[str, Any]:
    s = course.config.race.single
    plan = ContextPlan(seconds=s.seconds, seeds=s.seeds, fewest=min(s.fewest, s.seeds))
    rows = []
    for values, context, truth, nodes in course.single:
        context = context.to(course.dtype)
        known = nodes if ready.uniforms == "random" else None  # Sobol points do better than quadrature predicts
        row = race_context(ready, context, truth, plan, generator, allowance=course.allowance, nodes=known)
        rows.append({"context": values, **row})
    return {"contexts": rows}


def _verdict(found: dict[str, Any]) -> dict[str, Any]:
    """Whether any point of the cell is off the truth: "biased", "unbiased", or "untested".

    Where rare large weights decide, means of finitely many estimates are nearly always too small and a t-test says
    nothing: such rows count as untested, and the peer is marked for its tails instead.
    """
    rows = [found["stream"]] if "stream" in found else found["contexts"]
    tested = [p["p_value"] for row in rows if not heavy_tailed(row) for p in row["points"] if p["tested"]]
    if not tested:
        return {"verdict": "untested", "p_value": 1.0}
    p = -math.expm1(len(tested) * math.log1p(-min(min(tested), 1 - 1e-16)))
    return {"verdict": "biased" if p < LEVEL else "unbiased", "p_value": p}


def failed(result: dict[str, Any]) -> list[str]:
    """Names of the peers whose estimates are off the truth."""
    return sorted({cell["peer"] for cell in result["cells"] if cell.get("verdict") == "biased"})


def check(raw: RawConfig, config: Config) -> None:
    """Refuse peers, options and scenes that cannot race.

    Raises:
        ConfigError: naming the key.
    """
    from dsfit.experiment.reader import did_you_mean

    if not config.race.peers:
        raise raw.error(("race", "peers"), "at least one [[race.peers]] table", [])
    if config.sweep.grid:
        raise raw.error(("sweep", "grid"), "nothing where kind is 'race': a race has one scene")
    names = [peer.name for peer in config.race.peers]
    for k, peer in enumerate(config.race.peers):
        if peer.name in names[:k]:
            raise raw.error(("race", "peers", k, "name"), "names that differ from each other")
        if peer.kind not in registry.PEERS:
            known = "one of " + ", ".join(registry.PEERS) + did_you_mean(peer.kind, registry.PEERS)
            raise raw.error(("race", "peers", k, "kind"), known)
        try:
            registry.make(peer.kind, peer.options)
        except InputError as error:
            key = error.field.rpartition(".")[2]
            where = ("options", key) if key in peer.options else ("options",)
            raise raw.error(("race", "peers", k, *where), f"{error.allowed} ({error.field})") from None
    if config.race.implementation == "compiled" and config.estimate.dtype != "float32":
        raise raw.error(("race", "implementation"), "'eager' or 'auto' where estimate.dtype is float64")
    try:
        StreamReference.check_scene(build.integrand(config))
    except InputError as error:
        section = error.field.split(".")[0]
        where = section if section in ("fiber", "bsdf") else "light"
        raise raw.error((where,), f"{error.allowed} in a race", error.value) from None
