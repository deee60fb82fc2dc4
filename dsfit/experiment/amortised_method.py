"""The method "amortised" of a comparison: one proposal for all contexts, from a file or trained on the spot."""

from __future__ import annotations

import functools
from typing import TYPE_CHECKING, Any

import torch
from torch import nn

from dsfit.errors import InputError
from dsfit.experiment.schema_amortise import AmortisedMethod

if TYPE_CHECKING:
    from dsfit.experiment.reader import RawConfig
    from dsfit.experiment.schema import Config


def amortised(method: AmortisedMethod, config: Config) -> tuple[nn.Module, dict[str, Any]]:
    """The proposal and facts of its training, made once per process, fibre and options."""
    parts = (config.fiber, config.bsdf, config.estimate)
    key = (method.model_dump_json(exclude={"name"}), *(x.model_dump_json() for x in parts))
    return _made(_Keyed(key, (method, config)))


class _Keyed:
    """Arguments that are compared by their key."""

    def __init__(self, key: tuple[str, ...], arguments: tuple[Any, ...]) -> None:
        self.key, self.arguments = key, arguments

    def __hash__(self) -> int:
        return hash(self.key)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Keyed) and self.key == other.key


@functools.lru_cache(maxsize=8)
def _made(call: _Keyed) -> tuple[nn.Module, dict[str, Any]]:
    from dsfit.experiment import build
    from dsfit.fit.amortise import amortise

    method, config = call.arguments
    bsdf, seed = build.bsdf(config), config.estimate.seed
    if method.file is not None:
        return loaded(method.file, bsdf), {"seconds": method.file_seconds or 0.0, "from": method.file}
    found = amortise(bsdf, seconds=method.seconds, steps=method.steps, seed=seed)
    facts = {
        "seconds": found.seconds["total"],
        "parts": found.seconds,
        "steps": found.steps,
        "contexts": found.contexts,
        "parameters": sum(p.numel() for p in found.proposal.parameters()),
    }
    return found.proposal, facts


def loaded(path: str, bsdf: Any) -> nn.Module:
    """The amortised proposal in a file.

    Raises:
        InputError: no such file, a damaged one, another proposal, or one of another fibre.
    """
    from dsfit.experiment.store import load_proposal
    from dsfit.proposals.amortised import AmortisedProposal, fiber_numbers

    proposal = load_proposal(path)
    if not isinstance(proposal, AmortisedProposal):
        raise InputError(path, type(proposal).__name__, "an AmortisedProposal")
    own, given = fiber_numbers(bsdf), proposal.fiber.double()
    if not torch.equal(given, own):
        raise InputError(path, f"of fibre {given.tolist()}", f"a proposal of the config's fibre, {own.tolist()}")
    return proposal.requires_grad_(False)


def check_amortised(raw: RawConfig, index: int, method: AmortisedMethod, config: Config) -> None:
    """Refuse combinations and files that do not work.

    Raises:
        ConfigError: naming the method's key.
    """
    from dsfit.experiment import build

    if method.file is None:
        if method.file_seconds is not None:
            raise raw.error(("methods", index, "file_seconds"), "this key together with file")
        if method.steps is not None and method.seconds is not None:
            raise raw.error(("methods", index, "seconds"), "either seconds or steps")
        if not build.fiber(config.fiber, torch.float64).is_round:
            raise raw.error(("methods", index, "kind"), "other methods for an eccentric fibre")
        return
    for key in ("steps", "seconds"):
        if getattr(method, key) is not None:
            raise raw.error(("methods", index, key), "either file, or how long to train")
    try:
        loaded(method.file, build.bsdf(config))
    except InputError as error:
        raise raw.error(("methods", index, "file"), f"{error.allowed} (it is {error.value})") from None
