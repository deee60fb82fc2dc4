"""`amortise(bsdf, stream)`: one proposal for every context of a fibre."""

from __future__ import annotations

import copy
import math
import time
from dataclasses import dataclass, field

import torch

from dsfit.bsdf.dual_scattering import DualScattering
from dsfit.context import Context
from dsfit.errors import InputError, as_number
from dsfit.fit.amortise.descent import Progress, descend
from dsfit.fit.amortise.excess import all_excesses, excess_at
from dsfit.fit.amortise.targets import make_targets
from dsfit.proposals.amortised import AmortisedProposal, fiber_numbers
from dsfit.streams import ContextStream

TRAINING = ContextStream(theta="angle", theta_max=math.radians(89.8), rule="mixed", direct=0.2, n_mean=15.0)
"""Uniform in theta_r and nearly so in n to 30, v of every kind: what a renderer may meet, and a little beyond."""
STEPS = 2400
_RATE, _LAST_RATE = 7e-3, 1e-5
_BATCH = 12


@dataclass(frozen=True)
class Amortised:
    """A trained proposal, and what its training took.

    Attributes:
        proposal: the trained copy, in float64, its parameters no longer learnable.
        seconds: wall time: "proposal" (its tables), "targets" (the training contexts), "training", and "total".
        steps: of the training.
        contexts: number of training contexts.
        excess: of the training contexts by their quadrature, sorted.
        history: the objective over the training.
    """

    proposal: AmortisedProposal
    seconds: dict[str, float]
    steps: int
    contexts: int
    excess: list[float] = field(repr=False)
    history: list[Progress] = field(repr=False)


def amortise(
    bsdf: DualScattering,
    stream: ContextStream = TRAINING,
    *,
    seconds: float | None = None,
    steps: int | None = None,
    seed: int = 0,
    hidden: tuple[int, ...] = (32, 32),
    defensive: float = 0.001,
    start: AmortisedProposal | None = None,
    inclinations: int = 256,
    pairs: int = 16,
    scale: float = 0.01,
) -> Amortised:
    """Train an `AmortisedProposal` for the contexts of a stream, in a furnace.

    Minimised is the mean over contexts of log(1 + excess / scale): hard contexts count, but do not drown the others.
    The training set has `inclinations` viewing inclinations with `pairs` pairs (n, v) each, all drawn once from the
    stream; its best densities and the azimuthal laws are computed once (`make_targets`), so that a step evaluates the
    longitudinal lobes alone. Adam, with 12 inclinations a step and a rate that falls from
    7e-3 to 0 as a cosine.

    Args:
        bsdf: of one round fibre. `precision="table"` makes the targets tens of times faster.
        stream: of the training contexts. The default is uniform in theta_r, with v of every kind.
        seconds: wall time of the training proper, without targets; then the result depends on the machine.
        steps: number of steps, if `seconds` is not given; 2400 if neither is (about a minute of one core).
            Equal seeds and steps give equal results on one machine.
        seed: of the contexts, the order of the batches, and the network's first weights.
        hidden, defensive: see `AmortisedProposal`.
        start: a proposal of this fibre to go on from; its hidden layers and defensive share are kept.
        inclinations, pairs: size of the training set; memory is about 0.25 MB for each inclination.
        scale: excess below which contexts no longer count much.

    Raises:
        InputError: an eccentric fibre or a batch of fibres, a `start` of another fibre, both `seconds` and `steps`, or
            a number out of range.
    """
    _check(bsdf, stream, start, inclinations=(inclinations, 1), pairs=(pairs, 1), seed=(seed, 0))
    if seconds is not None and steps is not None:
        raise InputError("seconds, steps", (seconds, steps), "one of them")
    limit = math.inf if seconds is None else as_number("seconds", seconds, 0.0, open_low=True)
    steps = STEPS if steps is None and seconds is None else steps
    if steps is not None:
        _check_count("steps", steps, 0)
    scale = as_number("scale", scale, 0.0, open_low=True)
    began = time.perf_counter()
    if start is None:
        proposal = AmortisedProposal(bsdf, hidden, defensive, seed=seed)
    else:
        proposal = copy.deepcopy(start).double().requires_grad_(True)
    made = time.perf_counter()
    generator = torch.Generator().manual_seed(seed)
    targets = make_targets(bsdf, proposal, training_contexts(stream, inclinations, pairs, generator))
    ready = time.perf_counter()
    done, history = descend(
        proposal.parameters(),
        lambda rows: torch.log1p(excess_at(targets[rows], proposal) / scale).mean(),
        len(targets),
        generator,
        rate=_RATE,
        last_rate=_LAST_RATE,
        batch=_BATCH,
        steps=steps,
        limit=limit,
        every=20,
    )
    ended = time.perf_counter()
    spent = {"proposal": made - began, "targets": ready - made, "training": ended - ready, "total": ended - began}
    excess = torch.sort(all_excesses(targets, proposal).flatten()).values.tolist()
    return Amortised(proposal.requires_grad_(False), spent, done, inclinations * pairs, excess, history)


def _check(bsdf: DualScattering, stream: ContextStream, start: object, **counts: tuple[int, int]) -> None:
    if not isinstance(bsdf, DualScattering):
        raise InputError("bsdf", type(bsdf).__name__, "a dsfit DualScattering")
    if not bsdf.fiber.is_round:
        raise InputError("bsdf.fiber.eccentricity", bsdf.fiber.eccentricity.tolist(), "a round fibre (eccentricity 1)")
    if not isinstance(stream, ContextStream):
        raise InputError("stream", stream, "a dsfit ContextStream")
    if start is not None and not isinstance(start, AmortisedProposal):
        raise InputError("start", type(start).__name__, "an AmortisedProposal")
    if start is not None and not torch.equal(start.fiber.double(), fiber_numbers(bsdf)):
        raise InputError(
            "start", start.fiber.tolist(), f"a proposal of the BSDF's fibre, {fiber_numbers(bsdf).tolist()}"
        )
    for name, (value, low) in counts.items():
        _check_count(name, value, low)


def _check_count(name: str, value: object, low: int) -> None:
    if isinstance(value, bool) or not isinstance(value, int) or value < low:
        raise InputError(name, value, f"an integer >= {low}")


def training_contexts(stream: ContextStream, inclinations: int, pairs: int, generator: torch.Generator) -> Context:
    """Contexts `[inclinations, pairs]` of a stream that share theta_r along their rows."""
    theta_r = stream.draw(inclinations, generator).theta_r
    other = stream.draw(inclinations * pairs, generator)
    order = torch.randperm(inclinations * pairs, generator=generator)
    n, v = (x[order].reshape(inclinations, pairs) for x in (other.n, other.v))
    return Context(theta_r[:, None], 0.0, n, v)
