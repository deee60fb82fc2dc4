"""How far one network gets for a family of fibres: held-out fibres against per-fibre training, the untrained start and
the best mix of the chapter's proposals.

    python experiments/family.py [FOLDER] [--small]

computes `family.json`, `family.npz` and the trained `family_proposal.npz` in FOLDER (default runs/family; several
minutes of one core), draws `family.png` and `family.pdf` from the first two, and prints the tables. `--small` is a
trial of a minute, whose numbers mean nothing.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch

import dsfit
from dsfit.experiment.files import read_arrays, write_arrays, write_json
from dsfit.experiment.heuristic_mix import balance_fractions
from dsfit.experiment.plots.style import COLORS, new_figure, save, styled
from dsfit.fit.amortise.excess import all_excesses
from dsfit.fit.amortise.family import family_excess, train_family
from dsfit.fit.amortise.family_targets import FamilyTargets, family_targets
from dsfit.fit.amortise.targets import make_targets
from dsfit.fit.amortise.train import TRAINING, amortise
from dsfit.proposals import chapter_proposals
from dsfit.proposals.family import FamilyProposal
from dsfit.streams import ContextStream

STREAMS = {"angle": TRAINING, "sphere": ContextStream()}
SIZES = {
    "full": {"fibers": 96, "unseen": 24, "views": 6, "pairs": 6, "steps": 1200, "curve": (6, 24), "curve_steps": 600,
             "own": 2, "own_steps": 500, "own_views": 96, "exact": 8, "mixes": 12},
    "small": {"fibers": 4, "unseen": 4, "views": 2, "pairs": 2, "steps": 20, "curve": (2,), "curve_steps": 10,
              "own": 1, "own_steps": 10, "own_views": 8, "exact": 1, "mixes": 1},
}  # fmt: skip


def compute(folder: Path, size: dict[str, Any]) -> None:
    """Everything that the tables and the figure show."""
    generator = torch.Generator().manual_seed(2026)
    proposal = FamilyProposal()
    arrays: dict[str, np.ndarray] = {}
    result: dict[str, Any] = {"schema_version": 1, "sizes": size, "tables": seconds_of_tables(proposal)}

    fibers = proposal.family.draw(size["fibers"], generator)
    targets = family_targets(proposal, fibers, TRAINING, size["views"], size["pairs"], generator, progress=say)
    unseen = FamilyProposal().family.draw(size["unseen"], torch.Generator().manual_seed(31))
    presets = [dsfit.DualScattering(dsfit.Fiber.preset(name)) for name in dsfit.Fiber.presets()]
    judged = {
        name: family_targets(proposal, [*unseen, *presets], stream, size["views"], size["pairs"], generator)
        for name, stream in STREAMS.items()
    }
    arrays.update(about_fibers([*unseen, *presets]))
    count = len(unseen)

    trained, result["curve"] = proposal, []
    for number, steps in [*((k, size["curve_steps"]) for k in size["curve"]), (len(fibers), size["steps"])]:
        some = targets[targets.fiber < number]
        found = train_family(proposal, targets=some, steps=steps, seed=0)
        trained = found.proposal
        entry = {"fibers": number, "steps": steps, "training_seconds": found.seconds["training"]}
        entry["train"] = summary(torch.tensor(found.excess))
        entry |= {name: summary(family_excess(trained, some_of(t, 0, count))) for name, t in judged.items()}
        result["curve"].append(entry)
        print(json.dumps(entry), flush=True)
    result["targets_seconds"] = targets.seconds
    dsfit.save_proposal(folder / "family_proposal.npz", trained)

    for name, t in judged.items():
        for stage, one in (("untrained", proposal), ("trained", trained)):
            value = family_excess(one, t)
            arrays[f"{name}.{stage}"] = value.numpy()
            result[f"{name}.{stage}"] = summary(value[t.fiber < count])
            result[f"{name}.{stage}.presets"] = {
                preset: summary(value[t.fiber == count + k]) for k, preset in enumerate(dsfit.Fiber.presets())
            }
        arrays[f"{name}.fiber"], arrays[f"{name}.floor"] = t.fiber.numpy(), t.floor.numpy()
        arrays |= {f"{name}.{key}": getattr(t.targets.context, key).numpy() for key in ("theta_r", "n", "v")}
        result[f"{name}.worst"] = worst(t, arrays[f"{name}.trained"], count)
        flat = torch.tensor([not b.fiber.is_round for b in unseen])[t.fiber[t.fiber < count]]
        value = torch.from_numpy(arrays[f"{name}.trained"])[t.fiber < count]
        result[f"{name}.round"], result[f"{name}.eccentric"] = summary(value[~flat]), summary(value[flat])
    write_json(folder / "family.json", result)
    write_arrays(folder / "family.npz", arrays)

    rounded = [k for k, b in enumerate(unseen) if b.fiber.is_round]
    result["mix"] = against_mixes(trained, [unseen[k] for k in rounded], judged["angle"], rounded, size["mixes"])
    result["exact"] = against_exact(trained, unseen, judged["angle"], size["exact"])
    own = [("brown", presets[2]), ("black", presets[3]), *((f"unseen {k}", unseen[k]) for k in rounded)]
    result["own"] = {name: against_own(trained, bsdf, size) for name, bsdf in own[: 2 + size["own"]]}
    write_json(folder / "family.json", result)


def say(count: int) -> None:
    """A line every few fibres."""
    if count % 16 == 0:
        print(f"targets of {count} fibres", flush=True)


def summary(excess: torch.Tensor) -> dict[str, float]:
    """Quantiles of an excess."""
    flat = excess.flatten().double()
    if not len(flat):
        return {}
    levels = {"median": 0.5, "p95": 0.95, "p99": 0.99, "worst": 1.0}
    return {name: float(torch.quantile(flat, q)) for name, q in levels.items()}


def some_of(targets: FamilyTargets, first: int, last: int) -> FamilyTargets:
    """Views of fibres first <= k < last."""
    return targets[(targets.fiber >= first) & (targets.fiber < last)]


def about_fibers(fibers: list[dsfit.DualScattering]) -> dict[str, np.ndarray]:
    """Absorption, widths, shift and section of every fibre."""
    rows = [b.fiber for b in fibers]
    return {
        "sigma_a": torch.stack([f.sigma_a for f in rows]).numpy(),
        "beta_deg": torch.rad2deg(torch.stack([f.beta for f in rows])).numpy(),
        "alpha_deg": torch.rad2deg(torch.stack([f.alpha for f in rows])).numpy(),
        "eccentricity": torch.stack([f.eccentricity for f in rows]).numpy(),
    }


def worst(targets: FamilyTargets, excess: np.ndarray, count: int) -> list[dict[str, float]]:
    """The five largest excesses of unseen fibres, and where."""
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
) -> list[dict[str, float]]:
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
        values = {"family": own, "mix": mix}
        found.append({name: float((squared / p).sum() / norm**2 - 1) for name, p in values.items()})
        print("mix", found[-1], flush=True)
    return found


def against_exact(
    family: FamilyProposal, fibers: list[dsfit.DualScattering], targets: FamilyTargets, count: int
) -> list[dict[str, float]]:
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
        found.append({"used": float(value[row, column]), "exact": float(exact.value), "mass": float(exact.mass)})
        print("exact", found[-1], flush=True)
    return found


def against_own(family: FamilyProposal, bsdf: dsfit.DualScattering, size: dict[str, Any]) -> dict[str, Any]:
    """The family's proposal and one trained for this fibre alone, at contexts that neither has seen."""
    table = bsdf.replace(precision="table")
    own = amortise(table, inclinations=size["own_views"], pairs=8, steps=size["own_steps"], seed=1)
    generator = torch.Generator().manual_seed(99)
    judged = family_targets(family, [bsdf], TRAINING, 8 * size["views"], size["pairs"], generator)
    views = judged.targets.context.to(torch.float64)
    mine = all_excesses(make_targets(table, own.proposal, views), own.proposal)
    found = {"family": summary(family_excess(family, judged)), "own": summary(mine), "own_seconds": own.seconds}
    print("own", json.dumps(found), flush=True)
    return found


def plot(folder: Path) -> list[Path]:
    """Draw what `compute` stored."""
    result, arrays = json.loads((folder / "family.json").read_text()), read_arrays(folder / "family.npz")
    count = result["sizes"]["unseen"]
    with styled():
        figure = new_figure(9.0, 3.2)
        spread, curve, where = figure.subplots(1, 3)
        for color, name in zip(COLORS, STREAMS, strict=False):
            kept = arrays[f"{name}.fiber"] < count
            for stage, line in (("untrained", ":"), ("trained", "-")):
                value = np.sort(arrays[f"{name}.{stage}"][kept], axis=None)
                spread.plot(value, np.linspace(0, 1, len(value)), line, color=color, label=f"{name}, {stage}")
        spread.set(xscale="log", xlabel="excess, unseen fibres", ylabel="share of pairs below", ylim=(0, 1.01))
        numbers = [entry["fibers"] for entry in result["curve"]]
        for color, name in zip(COLORS, STREAMS, strict=False):
            for level, line in (("median", "-"), ("p99", "--")):
                values = [entry[name][level] for entry in result["curve"]]
                curve.plot(numbers, values, line, color=color, marker="o", ms=3, label=f"{name}, {level}")
        curve.set(xscale="log", yscale="log", xlabel="training fibres", ylabel="excess, unseen fibres")
        curve.set_xticks(numbers, [str(k) for k in numbers])
        curve.minorticks_off()
        largest = np.maximum(arrays["sigma_a"].max(-1), 5e-3)
        for k in range(count):
            value = arrays["angle.trained"][arrays["angle.fiber"] == k]
            face = COLORS[0] if arrays["eccentricity"][k] == 1 else "white"
            where.plot([largest[k]] * 2, np.quantile(value, [0.5, 0.99]), color="#bbbbbb", lw=1, zorder=1)
            where.plot(largest[k], np.median(value), "o", color=COLORS[0], mfc=face, ms=4)
            where.plot(largest[k], np.quantile(value, 0.99), "^", color=COLORS[0], mfc=face, ms=4)
        where.plot([], [], "o", color=COLORS[0], ms=4, label="median")
        where.plot([], [], "^", color=COLORS[0], ms=4, label="p99")
        where.plot([], [], "o", color=COLORS[0], mfc="white", ms=4, label="eccentric")
        where.set(xscale="log", yscale="log", xlabel="largest σ_a (left end: 0)", ylabel="excess, one fibre")
        for axis in (spread, curve, where):
            axis.legend(frameon=False, fontsize=7)
            axis.grid(True)
        return save(figure, folder, "family")


def tables(folder: Path) -> str:
    """Markdown."""
    result = json.loads((folder / "family.json").read_text())
    lines = ["| unseen fibres, contexts | median | p95 | p99 | worst |", "| --- | --- | --- | --- | --- |"]

    def add(title: str, found: dict[str, float]) -> None:
        if found:
            cells = " | ".join(f"{found[key]:.2g}" for key in ("median", "p95", "p99", "worst"))
            lines.append(f"| {title} | {cells} |")

    for name in STREAMS:
        add(f"{name}, untrained", result[f"{name}.untrained"])
        add(f"{name}, trained", result[f"{name}.trained"])
        add(f"{name}, trained, round", result[f"{name}.round"])
        add(f"{name}, trained, eccentric", result[f"{name}.eccentric"])
        for preset, found in result[f"{name}.trained.presets"].items():
            add(f"{name}, {preset}", found)
    for name, found in result.get("own", {}).items():
        add(f"{name}, family", found["family"])
        add(f"{name}, trained for it alone ({found['own_seconds']['total']:.0f} s)", found["own"])
    for entry in result["curve"]:
        add(f"angle, {entry['fibers']} training fibres, {entry['training_seconds']:.0f} s", entry["angle"])
    mixes = result.get("mix", [])
    if mixes:
        middle = {key: float(np.median([x[key] for x in mixes])) for key in ("family", "mix")}
        lines.append(f"\nMedian of {len(mixes)} pairs: family {middle['family']:.2g}, best mix {middle['mix']:.2g}.")
    spent = ", ".join(f"{key} {value:.2f} s" for key, value in result["tables"].items())
    lines.append(f"Tables of a new fibre: {spent}; targets {result['targets_seconds']:.0f} s.")
    return "\n".join(lines)


def main(arguments: list[str]) -> None:
    """Command line; see the module text."""
    names = [x for x in arguments if x != "--small"]
    folder = Path(names[0] if names else "runs/family")
    torch.set_num_threads(1)
    compute(folder, SIZES["small" if "--small" in arguments else "full"])
    plot(folder)
    print(tables(folder))


if __name__ == "__main__":
    main(sys.argv[1:])
