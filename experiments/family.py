"""How far one network gets for a family of fibres: held-out fibres against per-fibre training, the untrained start and
the best mix of the chapter's proposals.

Excesses are by quadrature, but those of trained networks are those of one training: what is told of them are quantiles,
with standard errors by the bootstrap over fibres (over views where there is one fibre).
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch

import dsfit
from dsfit.figures import Close, Data, Estimate, Experiment, Measured, Settings, Work
from dsfit.fit.amortise.family import family_excess, train_family
from dsfit.fit.amortise.family_targets import FamilyTargets, family_targets
from dsfit.fit.amortise.train import TRAINING
from dsfit.proposals.family import FamilyProposal
from dsfit.streams import ContextStream
from experiments._family_judge import (
    against_exact,
    against_mixes,
    against_own,
    named,
    quantiles,
    seconds_of_tables,
    worst,
)

STREAMS = {"angle": TRAINING, "sphere": ContextStream()}
CURVE = tuple(np.linspace(0.01, 0.99, 99))
"""Levels at which the distribution of excesses is kept."""


class Family(Settings):
    """`fibers` are trained on and `unseen` judged at, with `views` inclinations and `pairs` of n and v for each of
    these; `curve` are smaller numbers of training fibres, of `curve_steps`; `own` fibres (brown, black, unseen) are
    trained alone for `own_steps` at `own_views`; `exact` excesses are checked and `mixes` fitted."""

    fibers: int = 96
    unseen: int = 24
    views: int = 6
    pairs: int = 6
    steps: int = 1200
    curve: list[int] = [6, 24]
    curve_steps: int = 600
    own: int = 4
    own_steps: int = 500
    own_views: int = 96
    exact: int = 8
    mixes: int = 12
    seed: int = 0


def compute(settings: Family, work: Work) -> Data:
    """Everything that the tables and the figures show; the trained proposal goes to the experiment's folder."""
    generator = torch.Generator().manual_seed(2026)
    proposal, count = FamilyProposal(), settings.unseen
    record: dict[str, Any] = {"table_seconds": seconds_of_tables(proposal), "unseen": count}
    fibers = proposal.family.draw(settings.fibers, generator)
    targets = family_targets(
        proposal, fibers, TRAINING, settings.views, settings.pairs, generator,
        progress=lambda k: work.say(f"targets of {k} fibres") if k % 16 == 0 else None,
    )  # fmt: skip
    record["target_seconds"] = targets.seconds
    unseen = FamilyProposal().family.draw(count, torch.Generator().manual_seed(31))
    presets = [dsfit.DualScattering(dsfit.Fiber.preset(name)) for name in dsfit.Fiber.presets()]
    judged = {
        name: family_targets(proposal, [*unseen, *presets], stream, settings.views, settings.pairs, generator)
        for name, stream in STREAMS.items()
    }
    arrays = about_fibers([*unseen, *presets])
    trained, curve, record["training_seconds"] = train(settings, proposal, targets, judged, work)
    arrays |= curve
    dsfit.save_proposal(work.folder / "family_proposal.npz", trained)
    flat = np.array([not b.fiber.is_round for b in unseen])
    record["worst"] = {}
    for name, t in judged.items():
        for stage, one in (("untrained", proposal), ("trained", trained)):
            value = family_excess(one, t).numpy()
            arrays |= judge(f"{name}.{stage}", value, t.fiber.numpy(), flat)
        record["worst"][name] = worst(t, value, count)
    rounded = [k for k in range(count) if not flat[k]]
    arrays |= against_mixes(trained, [unseen[k] for k in rounded], judged["angle"], rounded, settings.mixes)
    arrays |= against_exact(trained, unseen, judged["angle"], settings.exact)
    alone = [("brown", presets[2]), ("black", presets[3]), *((f"unseen {k}", unseen[k]) for k in rounded)]
    record["own"], record["own_seconds"] = [name for name, _ in alone[: settings.own]], []
    for name, bsdf in alone[: settings.own]:
        found, seconds = against_own(trained, bsdf, settings)
        record["own_seconds"].append(seconds)
        arrays |= {key: value for who in found for key, value in named(f"own.{name}.{who}", found[who]).items()}
        work.say(f"{name} alone")
    return Data(arrays, record | {"levels": list(CURVE), "presets": list(dsfit.Fiber.presets())})


def train(
    settings: Family, proposal: FamilyProposal, targets: FamilyTargets, judged: dict[str, FamilyTargets], work: Work
) -> tuple[FamilyProposal, dict[str, np.ndarray], list[float]]:
    """The proposal trained on all fibres; quantiles by the number of training fibres; seconds of each training."""
    trained, seconds = proposal, []
    sizes = [*((k, settings.curve_steps) for k in settings.curve), (settings.fibers, settings.steps)]
    found: dict[str, list[Any]] = {name: [] for name in ("train", *judged)}
    for number, steps in sizes:
        result = train_family(proposal, targets=targets[targets.fiber < number], steps=steps, seed=settings.seed)
        trained = result.proposal
        seconds.append(result.seconds["training"])
        excess = np.asarray(result.excess)
        found["train"].append(quantiles(excess.reshape(len(excess), -1), np.arange(len(excess))))
        for name, t in judged.items():
            some = t[t.fiber < settings.unseen]
            found[name].append(quantiles(family_excess(trained, some), some.fiber))
        work.say(f"trained on {number} fibres")
    arrays = {"curve.fibers": np.array([number for number, _ in sizes]), "curve.steps": np.array([k for _, k in sizes])}
    for name, rows in found.items():
        arrays |= named(f"curve.{name}", *rows)
    return trained, arrays, seconds


def judge(prefix: str, value: np.ndarray, fiber: np.ndarray, flat: np.ndarray) -> dict[str, np.ndarray]:
    """Quantiles of the excess of unseen fibres, all, round and eccentric, by fibre, and of the presets."""
    count = len(flat)
    kinds = {"all": np.arange(count), "round": np.flatnonzero(~flat), "eccentric": np.flatnonzero(flat)}
    arrays = {}
    for kind, members in kinds.items():
        kept = np.isin(fiber, members)
        arrays |= named(f"{prefix}.{kind}", quantiles(value[kept], fiber[kept]))
    known = fiber < count
    arrays |= named(f"{prefix}.curve", quantiles(value[known], fiber[known], CURVE))
    single = {k: (value[fiber == k], np.arange(int((fiber == k).sum()))) for k in range(fiber.max() + 1)}
    by_fiber = [quantiles(*single[k]) for k in range(count)]
    arrays |= named(f"{prefix}.by_fiber", *by_fiber)
    for k, preset in enumerate(dsfit.Fiber.presets()):
        arrays |= named(f"{prefix}.{preset}", quantiles(*single[count + k]))
    return arrays


def about_fibers(fibers: list[dsfit.DualScattering]) -> dict[str, np.ndarray]:
    """Absorption, widths, shift and section of every fibre."""
    rows = [b.fiber for b in fibers]
    return {
        "fiber.sigma_a": torch.stack([f.sigma_a for f in rows]).numpy(),
        "fiber.beta_deg": torch.rad2deg(torch.stack([f.beta for f in rows])).numpy(),
        "fiber.alpha_deg": torch.rad2deg(torch.stack([f.alpha for f in rows])).numpy(),
        "fiber.eccentricity": torch.stack([f.eccentricity for f in rows]).numpy(),
    }


EXPERIMENT = Experiment(
    title="One proposal for a family of fibres",
    shows="Excess at fibres never trained on, by number of training fibres and by absorption; against per-fibre "
    "training, the untrained start and the best mix of the chapter's proposals.",
    settings=Family,
    compute=compute,
    minutes=8.1,
    reproduces={
        "*seconds*": Measured(),
        "worst.*": Measured(),  # extremes of one training, as are single pairs
        "*.worst": Measured(),
        "mix.family.pairs": Measured(),
        "exact.used": Measured(),
        "exact.exact": Measured(),
        "exact.mass": Close(1e-3),
        "mix.pairs": Close(0.02),
        "fiber.*": Close(1e-5, 1e-9),
        "*.untrained.*log10": Close(1e-3, 1e-3),
        "*.log10": Estimate(error="*.log10_error", most=math.inf),
    },
    small=(
        "fibers=4", "unseen=4", "views=2", "pairs=2", "steps=20", "curve=[2]", "curve_steps=10", "own=1",
        "own_steps=10", "own_views=8", "exact=1", "mixes=1",
    ),
)  # fmt: skip
