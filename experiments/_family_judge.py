"""Excesses of a trained family: quantiles with standard errors, and the peers that it is held against."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np
import torch

import dsfit
from dsfit.experiment.heuristic_mix import balance_fractions
from dsfit.fit.amortise.excess import all_excesses
from dsfit.fit.amortise.family import family_excess
from dsfit.fit.amortise.family_targets import FamilyTargets, family_targets
from dsfit.fit.amortise.targets import make_targets
from dsfit.fit.amortise.train import TRAINING, amortise
from dsfit.proposals import chapter_proposals
from dsfit.proposals.family import FamilyProposal

LEVELS = {"median": 0.5, "p95": 0.95, "p99": 0.99}
_LEAST = 1e-9
_RESAMPLES = 200


def quantiles(excess: Any, unit: Any, levels: Any = tuple(LEVELS.values())) -> dict[str, np.ndarray]:
    """Quantiles of an excess `[views, pairs]`: log10 of them; their standard errors by the bootstrap over units, the
    fibre or the view, `[views]`, that each row belongs to (0 for a single unit); and the largest excess of all."""
    log = np.log10(np.maximum(np.asarray(excess, dtype=np.float64), _LEAST))
    unit, level = np.asarray(unit), np.asarray(levels)
    if not log.size:
        none = np.full(len(level), np.nan)
        return {"log10": none, "log10_error": none, "worst": np.array(np.nan)}
    parts = [log[unit == k].ravel() for k in np.unique(unit)]
    random = np.random.default_rng(0)
    drawn = []
    for _ in range(_RESAMPLES):
        chosen = random.integers(len(parts), size=len(parts))
        drawn.append(np.quantile(np.concatenate([parts[k] for k in chosen]), level))
    error = np.std(drawn, axis=0, ddof=1) if len(parts) > 1 else np.zeros(len(level))
    return {"log10": np.quantile(log, level), "log10_error": error, "worst": np.array(10 ** log.max())}


def named(prefix: str, *found: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """`quantiles` as arrays of a data file; several of them stacked."""
    several = len(found) > 1
    return {f"{prefix}.{key}": np.array([one[key] for one in found]) if several else found[0][key] for key in found[0]}


def worst(targets: FamilyTargets, excess: np.ndarray, count: int) -> list[dict[str, float]]:
    """The five largest excesses of the first `count` fibres, and where."""
    context, pairs = targets.targets.context, excess.shape[1]
    kept = np.where(targets.fiber.numpy()[:, None] < count, excess, -1.0)
    found = []
    for index in np.argsort(kept, axis=None)[::-1][:5]:
        row, column = divmod(int(index), pairs)
        place = {key: float(getattr(context, key)[row, column]) for key in ("theta_r", "n", "v")}
        place["theta_r_deg"] = float(np.rad2deg(place.pop("theta_r")))
        found.append({"excess": float(excess[row, column]), "fiber": int(targets.fiber[row]), **place})
    return found


def seconds_of_tables(proposal: FamilyProposal) -> dict[str, float]:
    """Seconds of `family.of` for new fibres: least of five, in processor time, which other work on the machine does not
    stretch; and of the BSDF's own tables."""

    def least(make: Callable[[], object]) -> float:
        spent = []
        for _ in range(5):
            began = time.process_time()
            make()
            spent.append(time.process_time() - began)
        return min(spent)

    def own_tables() -> None:
        bsdf = dsfit.DualScattering(dsfit.Fiber.preset("brown"), precision="table")
        bsdf(*torch.zeros(3, 1, dtype=torch.float64), 1.0, 0.5)

    return {
        "round": least(lambda: proposal.of(dsfit.DualScattering(dsfit.Fiber.preset("brown")))),
        "eccentric": least(lambda: proposal.of(dsfit.DualScattering(dsfit.Fiber.preset("brown", eccentricity=0.9)))),
        "bsdf": least(own_tables),
    }


def pair_of(targets: FamilyTargets, fiber: int, k: int) -> tuple[dsfit.Context, int, int]:
    """The k-th pair of a fibre: its context, row and column."""
    rows = torch.nonzero(targets.fiber == fiber)[:, 0]
    pairs = targets.floor.shape[1]
    row, column = int(rows[(k // pairs) % len(rows)]), k % pairs
    return targets.targets.context[row, column].to(torch.float64), row, column


def against_mixes(
    family: FamilyProposal, fibers: list[dsfit.DualScattering], targets: FamilyTargets, numbers: list[int], count: int
) -> dict[str, np.ndarray]:
    """Excess of the family's proposal and of the best balance mix of the chapter's proposals on the same nodes."""
    found = []
    for k in range(count):
        bsdf = fibers[k % len(fibers)].replace(precision="table")
        context, _, _ = pair_of(targets, numbers[k % len(fibers)], 7 * k)
        nodes = dsfit.quadrature_nodes(dsfit.Integrand(bsdf), context, 1e-3)
        chapter = chapter_proposals(bsdf, learnable=False).values()
        with torch.no_grad():
            log_p = torch.stack([p(context).log_prob(nodes.omega) for p in chapter])
            own = torch.exp(family.of(bsdf)(context).log_prob(nodes.omega))
        squared, norm = nodes.weight * nodes.norm**2, (nodes.weight * nodes.norm).sum()
        shares, _ = balance_fractions(log_p, squared)
        mix = shares @ torch.exp(log_p)
        found.append([float((squared / p).sum() / norm**2 - 1) for p in (own, mix)])
    family_values, mixes = np.array(found).reshape(-1, 2).T
    middle = named("mix.family", quantiles(family_values[:, None], np.arange(len(found)), (0.5,)))
    return {"mix.pairs": mixes, "mix.family.pairs": family_values, **middle}


def against_exact(
    family: FamilyProposal, fibers: list[dsfit.DualScattering], targets: FamilyTargets, count: int
) -> dict[str, np.ndarray]:
    """Excess by the quadrature used here and by `dsfit.excess` with the BSDF's own tables: typical pairs, and the
    worst of a round fibre."""
    value = family_excess(family, targets)
    numbers = [k for k, b in enumerate(fibers) if b.fiber.is_round]
    places = [(numbers[k % len(numbers)], 5 * k) for k in range(count)]
    of_round = value * torch.isin(targets.fiber, torch.tensor(numbers))[:, None]
    row, column = divmod(int(of_round.argmax()), value.shape[1])
    first = int(torch.nonzero(targets.fiber == targets.fiber[row])[0, 0])
    places.append((int(targets.fiber[row]), (row - first) * value.shape[1] + column))
    found = []
    for number, k in places:
        context, row, column = pair_of(targets, number, k)
        bsdf = fibers[number].replace(precision="table")
        exact = dsfit.excess(dsfit.Integrand(bsdf), family.of(bsdf), context, 1e-2)
        found.append([float(value[row, column]), float(exact.value), float(exact.mass)])
    return {f"exact.{name}": column for name, column in zip(("used", "exact", "mass"), np.array(found).T, strict=True)}


def against_own(
    family: FamilyProposal, bsdf: dsfit.DualScattering, size: Any
) -> tuple[dict[str, dict[str, np.ndarray]], float]:
    """Quantiles of the family's proposal and of one trained for this fibre alone, at contexts that neither has seen;
    and the seconds of that training."""
    table = bsdf.replace(precision="table")
    own = amortise(table, inclinations=size.own_views, pairs=8, steps=size.own_steps, seed=1)
    generator = torch.Generator().manual_seed(99)
    judged = family_targets(family, [bsdf], TRAINING, 8 * size.views, size.pairs, generator)
    views = judged.targets.context.to(torch.float64)
    mine = all_excesses(make_targets(table, own.proposal, views), own.proposal)
    unit = np.arange(len(judged.fiber))
    found = {"family": quantiles(family_excess(family, judged), unit), "own": quantiles(mine, unit)}
    return found, own.seconds["total"]
