"""A conditional normalising flow, trained once for a fibre and its stream of contexts."""

from __future__ import annotations

import hashlib
import json
import time
from pathlib import Path
from typing import ClassVar

import torch

from dsfit.context import Context
from dsfit.errors import InputError, as_number
from dsfit.proposals.table_2d import check_count
from dsfit.race.density import DensitySampler
from dsfit.race.peer import Peer, Problem, Sampler
from dsfit.race.peers.flow_density import FlowProposal
from dsfit.race.peers.flow_training import train

_ENDS = {"open_low": True, "open_high": True}


class ZukoFlow(Peer):
    """zuko's neural circular spline flow on the torus (2 theta_i + 2 theta_r, phi), conditional on (theta_r, n, v).

    Trained in `prepare` on importance samples (`flow_training.train`); then p = (1 - defensive) q + defensive / 4 pi.

    Args:
        seconds: of training, at most. steps: of training, at most.
        transforms, bins, hidden: of the flow. rate: Adam's first learning rate.
        defensive: share of the uniform sphere.
        state: a file; if it is there, the flow is loaded from it and its seconds of training count as spent, else the
            flow is trained and saved to it. What the file was trained for must agree.

    Raises:
        InputError: an option out of range; (in `prepare`) a file trained for something else.
    """

    name: ClassVar[str] = "zuko_flow"
    needs: ClassVar[tuple[str, ...]] = ("zuko",)

    def __init__(
        self,
        seconds: float = 120.0,
        steps: int = 20_000,
        transforms: int = 1,
        bins: int = 16,
        hidden: tuple[int, ...] = (64, 64),
        rate: float = 1e-2,
        defensive: float = 0.01,
        state: str | None = None,
    ) -> None:
        self.seconds = as_number("zuko_flow.seconds", seconds, 0.0, open_low=True)
        self.steps, self.transforms = (
            check_count("zuko_flow.steps", steps),
            check_count("zuko_flow.transforms", transforms),
        )
        self.bins = check_count("zuko_flow.bins", bins, 2)
        self.hidden = tuple(check_count("zuko_flow.hidden", size) for size in hidden)
        self.rate = as_number("zuko_flow.rate", rate, 0.0, open_low=True)
        self.defensive = as_number("zuko_flow.defensive", defensive, 0.0, 1.0, **_ENDS)
        self.state = None if state is None else Path(state)

    def prepare(self, problem: Problem) -> None:
        """Train, or load what was trained before."""
        self.problem = problem
        shape = (self.transforms, self.bins, self.hidden)
        self.proposal = FlowProposal(*shape, self.defensive, problem.seed).to(problem.dtype)
        if self.state is not None and self.state.exists():
            self._load(self.state)
        else:
            start = time.perf_counter()
            generator = torch.Generator().manual_seed(problem.seed)
            self.losses = train(problem, self.proposal, self.seconds, self.steps, self.rate, generator)
            if self.state is not None:
                self._save(self.state, time.perf_counter() - start)
        self.proposal.requires_grad_(False)

    def at(self, contexts: Context) -> Sampler:
        """Nothing but the features of the contexts."""
        return DensitySampler(self.problem, self.proposal(contexts), contexts)

    def _trained_for(self) -> str:
        """What must agree for trained weights to be of use: fibre, stream, dtype and the flow's and training's options,
        hashed."""
        bsdf = self.problem.model.bsdf
        fiber = {name: value.tolist() for name, value in bsdf.fiber.parameters().items()}
        scene = [fiber, float(bsdf.d_f), float(bsdf.d_b), bsdf.model, repr(bsdf.convention), repr(self.problem.stream)]
        own = [self.seconds, self.steps, self.transforms, self.bins, self.hidden, self.rate, self.problem.seed]
        text = json.dumps([*scene, *own, str(self.problem.dtype)])
        return hashlib.sha256(text.encode()).hexdigest()

    def _save(self, path: Path, seconds: float) -> None:
        from safetensors.torch import save_file

        record = {"trained_for": self._trained_for(), "seconds": repr(seconds), "steps": str(len(self.losses))}
        save_file({k: x.contiguous() for k, x in self.proposal.state_dict().items()}, path, record)

    def _load(self, path: Path) -> None:
        from safetensors import safe_open

        with safe_open(path, framework="pt") as file:
            record = file.metadata() or {}
            if record.get("trained_for") != self._trained_for():
                raise InputError(
                    "zuko_flow.state", str(path), "a flow trained for this fibre, stream and options"
                )
            self.proposal.load_state_dict({name: file.get_tensor(name) for name in file.keys()})  # noqa: SIM118
        self.recorded_seconds = float(record["seconds"])
