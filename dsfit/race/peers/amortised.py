"""One proposal trained once for every context of the fibre."""

from __future__ import annotations

from typing import Any, ClassVar

from dsfit.bsdf.dual_scattering import DualScattering
from dsfit.context import Context
from dsfit.errors import InputError, as_number
from dsfit.proposals.base import Proposal
from dsfit.race.clock import timed
from dsfit.race.density import DensitySampler
from dsfit.race.peer import Peer, Problem, Sampler

_TRAINED: dict[str, tuple[Proposal, float]] = {}


class Amortised(Peer):
    """`dsfit.amortise` over the contexts of a fibre; each context then costs one pass through a small network.

    Peers of one process with equal options train once: the seconds of that training count for each of them.

    Args:
        train: whether the proposal is trained; else it is used as its closed forms start it.
        file: a proposal of `dsfit.save_proposal` to use instead.
        file_seconds: how long that was trained; counted as preparation.
        training: keyword arguments of `dsfit.amortise` (`seconds`, `steps`, `hidden`, `defensive`).

    Raises:
        InputError: a file without its seconds, or the seconds without a file; `training` that is no table.
    """

    name: ClassVar[str] = "amortised"

    def __init__(
        self,
        train: bool = True,
        file: str | None = None,
        file_seconds: float | None = None,
        training: dict[str, Any] | None = None,
    ) -> None:
        if (file is None) != (file_seconds is None):
            raise InputError(f"{self.name}.file_seconds", file_seconds, "the seconds of training of `file`, with it")
        self.train, self.file = bool(train), file
        self.file_seconds = 0.0 if file_seconds is None else as_number(f"{self.name}.file_seconds", file_seconds, 0.0)
        if training is not None and not isinstance(training, dict):
            raise InputError(f"{self.name}.training", training, "keyword arguments of dsfit.amortise")
        self.training = dict(training or {})

    def prepare(self, problem: Problem) -> None:
        """Train, load, or find what was trained before."""
        self.problem = problem
        self.proposal = self._proposal(problem)

    def _proposal(self, problem: Problem) -> Proposal:
        bsdf = problem.model.bsdf
        if self.file is not None:
            from dsfit.experiment.store import load_proposal

            self.recorded_seconds = self.file_seconds
            return load_proposal(self.file).requires_grad_(False)
        if not self.train:
            from dsfit.proposals.amortised import AmortisedProposal

            return AmortisedProposal(bsdf, **self.training).requires_grad_(False)
        key = repr((_identity(bsdf), sorted(self.training.items()), problem.seed))
        if key in _TRAINED:
            proposal, self.recorded_seconds = _TRAINED[key]
            return proposal
        _TRAINED[key] = timed(lambda: trained(problem, self.training))
        return _TRAINED[key][0]

    def at(self, contexts: Context) -> Sampler:
        """One pass through the network."""
        return DensitySampler(self.problem, self.proposal(contexts), contexts)


def _identity(bsdf: DualScattering) -> tuple[Any, ...]:
    """What the BSDF is, as plain data."""
    fiber = {name: value.tolist() for name, value in bsdf.fiber.parameters().items()}
    return fiber, float(bsdf.d_f), float(bsdf.d_b), bsdf.model, bsdf.convention, bsdf.precision


def trained(problem: Problem, options: dict[str, Any]) -> Proposal:
    """The proposal of `dsfit.amortise` with the problem's seed and `options`, with nothing left to learn."""
    from dsfit.fit.amortise import amortise

    return amortise(problem.model.bsdf, seed=problem.seed, **options).proposal.requires_grad_(False)
