"""`train_family`: one training for every fibre of a family and every shading context."""

from __future__ import annotations

import copy
import time
from collections.abc import Callable
from dataclasses import dataclass, field

import torch

from dsfit.errors import InputError, as_number
from dsfit.fit.amortise.descent import Progress, descend
from dsfit.fit.amortise.family_targets import FamilyTargets, family_targets
from dsfit.fit.amortise.train import TRAINING
from dsfit.proposals.family import FamilyProposal
from dsfit.streams import ContextStream

FIBERS, STEPS = 256, 3000
_RATE = 5e-3
_BATCH, _AT_ONCE = 32, 64


@dataclass(frozen=True)
class TrainedFamily:
    """A trained family proposal, and what its training took.

    Attributes:
        proposal: the trained copy, its parameters no longer learnable.
        seconds: wall time: "targets" (tables and best densities of the training fibres) and "training".
        steps, views, contexts: of the training.
        excess: of the training contexts by their quadrature, sorted.
        history: the objective over the training.
    """

    proposal: FamilyProposal
    seconds: dict[str, float]
    steps: int
    views: int
    contexts: int
    excess: list[float] = field(repr=False)
    history: list[Progress] = field(repr=False)


def train_family(
    proposal: FamilyProposal,
    *,
    fibers: int = FIBERS,
    inclinations: int = 6,
    pairs: int = 6,
    stream: ContextStream = TRAINING,
    steps: int = STEPS,
    seed: int = 0,
    scale: float = 0.01,
    targets: FamilyTargets | None = None,
    progress: Callable[[int], None] | None = None,
) -> TrainedFamily:
    """Train a copy of a family proposal on fibres and contexts drawn at random.

    Minimised is the mean of log(1 + excess / scale) over (fibre, context) pairs, by Adam with a rate that falls from
    5e-3 to 0 as a cosine. What a fibre's tables say is computed once, before the steps, which then touch the network
    alone. Equal seeds give equal results on one machine.

    Args:
        proposal: what to start from.
        fibers: number of training fibres, drawn from the family.
        inclinations, pairs: views of every fibre, and pairs (n, v) of each view.
        stream: of the contexts.
        steps: of 32 views each.
        seed: of fibres, contexts and the order of the views.
        scale: excess below which pairs no longer count much.
        targets: made before, by `family_targets`; then `fibers`, `inclinations`, `pairs` and `stream` are not used.
        progress: told the number of fibres whose targets are made.

    Raises:
        InputError: a proposal that is none, or a number out of range.
    """
    if not isinstance(proposal, FamilyProposal):
        raise InputError("proposal", type(proposal).__name__, "a FamilyProposal")
    counts = {"fibers": fibers, "inclinations": inclinations, "pairs": pairs, "steps": steps}
    for name, value in counts.items():
        least = 0 if name == "steps" else 1
        if isinstance(value, bool) or not isinstance(value, int) or value < least:
            raise InputError(name, value, f"an integer >= {least}")
    scale = as_number("scale", scale, 0.0, open_low=True)
    proposal = copy.deepcopy(proposal).double().requires_grad_(True)
    generator = torch.Generator().manual_seed(seed)
    if targets is None:
        drawn = proposal.family.draw(fibers, generator)
        targets = family_targets(proposal, drawn, stream, inclinations, pairs, generator, progress=progress)
    began = time.perf_counter()
    _, history = descend(
        proposal.parameters(),
        lambda rows: torch.log1p(targets[rows].excess(proposal.network, proposal.defensive) / scale).mean(),
        len(targets),
        generator,
        rate=_RATE,
        batch=_BATCH,
        steps=steps,
        every=50,
    )
    spent = {"targets": targets.seconds, "training": time.perf_counter() - began}
    excess = torch.sort(family_excess(proposal, targets).flatten()).values.tolist()
    proposal.requires_grad_(False)
    return TrainedFamily(proposal, spent, steps, len(targets), targets.floor.numel(), excess, history)


@torch.no_grad()
def family_excess(proposal: FamilyProposal, targets: FamilyTargets) -> torch.Tensor:
    """Excess of the family's proposals at the contexts of the targets, by their quadrature, `[views, M]`."""
    rows = range(0, len(targets), _AT_ONCE)
    return torch.cat([targets[i : i + _AT_ONCE].excess(proposal.network, proposal.defensive) for i in rows])


__all__ = ["FIBERS", "STEPS", "TrainedFamily", "family_excess", "train_family"]
