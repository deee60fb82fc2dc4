"""One cell of an amortising experiment: a proposal trained for every context of a fibre, judged where it has not
been."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from dsfit.context import Context
from dsfit.experiment import build
from dsfit.experiment.cells import Job
from dsfit.experiment.rundir import RunDirectory
from dsfit.experiment.schema import Config
from dsfit.experiment.schema_amortise import TrainingStream
from dsfit.experiment.store import save_proposal
from dsfit.streams import ContextStream

if TYPE_CHECKING:
    from dsfit.experiment.reader import RawConfig

NAME = "amortised"
BEYOND_DEG = (0.0, 60.0, 89.9, -89.9)
BEYOND_N = (0.0, 100.0, 300.0, 1e4)


def amortise(
    job: Job, directory: RunDirectory | None, say: Callable[[str], None]
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Numbers and arrays of one cell; the proposal is saved on the way, if there is a directory."""
    from dsfit.fit.amortise import amortise as train
    from dsfit.fit.amortise import held_out
    from dsfit.proposals import AmortisedProposal
    from dsfit.scene import Integrand

    config, options = job.config, job.config.amortise
    bsdf, seed = build.bsdf(config), job.config.estimate.seed
    say("training")
    found = train(
        bsdf, stream(options.stream), seconds=options.seconds, steps=options.steps, seed=seed,
        hidden=tuple(options.hidden), defensive=options.defensive, inclinations=options.inclinations,
        pairs=options.pairs, scale=options.scale,
    )  # fmt: skip
    kept: dict[str, Any] = {}
    if directory is not None:
        path = directory.proposal_path(job.index, NAME)
        save_proposal(path, found.proposal)
        kept["file"] = path.relative_to(directory.path).as_posix()
    integrand = Integrand(bsdf)
    say("unseen contexts")
    unseen = held_out(integrand, found.proposal, check=options.check)
    start = held_out(
        integrand, AmortisedProposal(bsdf, tuple(options.hidden), options.defensive), unseen.context, check=0
    )
    say("beyond")
    beyond = held_out(integrand, found.proposal, beyond_contexts(), check=0)
    data = {
        **kept,
        "training": {
            "seconds": found.seconds,
            "steps": found.steps,
            "contexts": found.contexts,
            "parameters": sum(p.numel() for p in found.proposal.parameters()),
            "excess": np.quantile(found.excess, [0.5, 0.95, 0.99, 1.0]).tolist(),
            "history": [[p.step, p.seconds, p.objective] for p in found.history],
        },
        "start": start.plain(),
        "held_out": unseen.plain(),
        "beyond": [
            {"theta_r_deg": math.degrees(float(one.theta_r)), "n": float(one.n), "v": float(one.v),
             "excess": float(value), "largest_weight": float(weight)}
            for one, value, weight in zip(
                map(beyond.context.__getitem__, range(len(beyond.context))), beyond.excess, beyond.largest_weight,
                strict=True,
            )
        ],
    }  # fmt: skip
    context = unseen.context
    arrays = {
        "theta_r_deg": np.degrees(context.theta_r.numpy()), "n": context.n.numpy(), "v": context.v.numpy(),
        "excess": unseen.excess.numpy(), "largest_weight": unseen.largest_weight.numpy(),
        "start_excess": start.excess.numpy(),
    }  # fmt: skip
    return data, arrays


def stream(config: TrainingStream) -> ContextStream:
    """The training contexts' stream."""
    options = config.model_dump()
    return ContextStream(theta_max=math.radians(options.pop("theta_max_deg")), **options)


def beyond_contexts() -> Context:
    """Contexts outside the training's ranges: views to +-89.9 degrees, n to 1e4 (where even float64 may know no a_f^n,
    and the excess is nan)."""
    theta = torch.tensor(BEYOND_DEG, dtype=torch.float64)[:, None] * (math.pi / 180)
    n = torch.tensor(BEYOND_N, dtype=torch.float64)
    return Context(theta, 0.0, n).reshape(-1)


def check(raw: RawConfig, config: Config) -> None:
    """Refuse what the training cannot do.

    Raises:
        ConfigError: naming the key.
    """
    options = config.amortise
    if options.steps is not None and options.seconds is not None:
        raise raw.error(("amortise", "seconds"), "either seconds or steps")
    if not build.fiber(config.fiber, torch.float64).is_round:
        raise raw.error(("fiber", "eccentricity"), "1 (a round fibre), as kind is 'amortise'")
