"""What `dsfit export` is pointed to: a config, or a saved proposal."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any

import torch

from dsfit.bsdf.dual_scattering import DualScattering
from dsfit.bsdf.fiber import Fiber
from dsfit.errors import InputError
from dsfit.export.served import check_bsdf, check_exported
from dsfit.proposals.amortised import AmortisedProposal
from dsfit.proposals.lobe_moments import LobeMoments

Exported = tuple[DualScattering, AmortisedProposal, dict[str, Any]]


def from_config(path: str | Path, changes: list[str], proposal: str | Path | None, steps: int | None) -> Exported:
    """BSDF, proposal, and facts of its training, for a config.

    The proposal is that of a file, or trained as the config's `[amortise]` says, for `steps` if given; 0 steps leave
    it as the closed forms start it.

    Raises:
        InputError: the config is wrong, the file is not a proposal of its fibre, or a header cannot hold it.
    """
    from dsfit.experiment import amortise, build
    from dsfit.experiment.amortised_method import loaded
    from dsfit.experiment.validation import load
    from dsfit.fit.amortise import amortise as train

    config = load(path, changes).config
    bsdf, options, seed = build.bsdf(config), config.amortise, config.estimate.seed
    if proposal is not None and steps is not None:
        raise InputError("steps", steps, "either a proposal, or how long to train one")
    if proposal is not None:
        found = loaded(str(proposal), bsdf)
        return bsdf, found, {"loaded from": _file(proposal)}
    check_bsdf(bsdf)
    untrained = AmortisedProposal(bsdf, tuple(options.hidden), options.defensive, seed=seed)
    if steps is None and options.seconds is None:
        steps = options.steps
    if steps == 0:
        return bsdf, untrained.requires_grad_(False), {}
    done = train(
        bsdf, amortise.stream(options.stream), seconds=options.seconds if steps is None else None, steps=steps,
        seed=seed, inclinations=options.inclinations, pairs=options.pairs, scale=options.scale, start=untrained,
    )  # fmt: skip
    excess = torch.tensor(done.excess)
    facts = {
        "training": f"{done.steps} steps, {done.contexts} contexts, seed {seed}",
        "excess at them": f"median {float(excess.median()):.2g}, largest {float(excess.max()):.2g}",
    }
    return bsdf, done.proposal, facts


def from_proposal(path: str | Path) -> Exported:
    """The same for a file of `dsfit.save_proposal`, whose BSDF is taken to follow the consistent equations.

    Raises:
        InputError: not such a file, or its tables are those of other equations: then the config is needed as well.
    """
    from dsfit.experiment.store import load_proposal

    proposal = load_proposal(path)
    if type(proposal) is not AmortisedProposal:
        raise InputError(str(path), type(proposal).__name__, "a file with an AmortisedProposal")
    bsdf = bsdf_of(proposal)
    check_exported(bsdf, proposal)
    own, given = LobeMoments(bsdf), proposal.lobes
    for name in ("direct", "scattered"):
        a, b = getattr(own, name), getattr(given, name).double()
        if a.shape != b.shape or not torch.allclose(a, b, rtol=1e-4, atol=1e-3):
            raise InputError(str(path), "tables of other equations", "its config: dsfit export CONFIG --proposal FILE")
    return bsdf, proposal.requires_grad_(False), {"loaded from": _file(path)}


def bsdf_of(proposal: AmortisedProposal) -> DualScattering:
    """The BSDF of a proposal's fibre and density factors, by the consistent equations."""
    numbers = proposal.fiber.double()
    sizes = {name: value.numel() for name, value in Fiber().parameters().items()}
    sizes["sigma_a"] = len(numbers) - 2 - sum(n for name, n in sizes.items() if name != "sigma_a")
    parts = dict(zip(sizes, numbers[:-2].split(list(sizes.values())), strict=True))
    fiber = Fiber(**{k: x if k in ("sigma_a", "alpha", "beta") else x[0] for k, x in parts.items()})
    return DualScattering(fiber, *numbers[-2:].tolist(), precision="table" if fiber.is_round else "exact")


def _file(path: str | Path) -> str:
    return f"{Path(path).name}, SHA-256 {hashlib.sha256(Path(path).read_bytes()).hexdigest()}"
