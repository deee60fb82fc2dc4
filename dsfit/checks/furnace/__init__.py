"""White furnace and ring light, single samples, energy, symmetries and limits of a fibre and of what samples it.

Published hair samplers pass white furnace tests while they return directions that their density does not describe, by
factors of 2 to 17 under a ring light. A furnace averages such errors away; rings do not. The functions here take any
integrand and any proposal, dsfit's own or a user's; `run` turns them into findings for `dsfit check`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch

from dsfit.checks.finding import Finding
from dsfit.checks.furnace.approach import Approach, approach, linear_approach
from dsfit.checks.furnace.controls import ConstantIntegrand, FlippedInclination, Folded, PermutedRings, ScaledDensity
from dsfit.checks.furnace.draws import Draws, draw
from dsfit.checks.furnace.energy import (
    azimuthal_energies,
    independent_energies,
    single_furnace,
    single_scattering,
)
from dsfit.checks.furnace.limits import limits
from dsfit.checks.furnace.model import energy_findings, known_findings, limit_findings, symmetry_findings
from dsfit.checks.furnace.nodes import NodeDensity, PartitionNodes, partition_nodes
from dsfit.checks.furnace.partition import Partition
from dsfit.checks.furnace.rings import WeightedCounts, WhiteFurnace, ring_light, weighted_counts, white_furnace
from dsfit.checks.furnace.sampling import (
    Case,
    ProposalMaker,
    Record,
    control_findings,
    controls,
    default_proposals,
    furnace_case,
    integrand_findings,
    judge_proposal,
    material_findings,
    proposal_findings,
    total_only_findings,
)
from dsfit.checks.furnace.symmetry import symmetries
from dsfit.checks.furnace.weights import MaterialConsistency, SampleWeights, material_consistency, sample_weights
from dsfit.checks.subject import Outcome, Say, silent
from dsfit.context import Context
from dsfit.scene.integrand import Integrand
from dsfit.scene.scattering import ConstantScattering

_CONTROL_SAMPLES = 8192
_PHI_R = 0.7  # of every viewer: matters to eccentric sections and to scattering that depends on azimuth


def run(
    integrand: Integrand,
    *,
    seed: int,
    say: Say = silent,
    inclinations_deg: Sequence[float] = (0.0, -50.0, 75.0, 89.9),
    n: Sequence[float] = (0.0, 3.0),
    samples: int = 8192,
    rings: int = 36,
    wedges: int = 8,
    proposals: ProposalMaker | None = None,
) -> Outcome:
    """All tests of this package for the BSDF and scattering of a scene; its light is replaced by radiance 1.

    Args:
        integrand: the scene.
        seed: of all random numbers.
        say: told what is being done.
        inclinations_deg: of the viewer, degrees.
        n: scattering fibres, where the scene leaves them to the context; other scenes have their own.
        samples: directions per proposal and inclination.
        rings, wedges: equal cells in theta_i and in phi.
        proposals: `(integrand, context) -> {name: proposal}`, in place of the chapter's, their mixture and the
            structured family.
    """
    furnace = Integrand(integrand.bsdf, scattering=integrand.scattering)
    partition = Partition.even(rings, wedges)
    make = default_proposals if proposals is None else proposals
    cases, findings, good = [], [], Record()
    for k, (label, context) in enumerate(_contexts(furnace, inclinations_deg, n)):
        say(f"furnace: {label}")
        case = furnace_case(furnace, context, label, partition)
        cases.append(case)
        findings += integrand_findings(case)
        found = make(furnace, context)
        for j, (name, proposal) in enumerate(found.items()):
            tested = judge_proposal(furnace, case, proposal, samples, _generator(seed, 0, k, j))
            good.rows[k, name] = tested
            findings += proposal_findings(name, case, tested)
        for j, name in enumerate([x for x in ("structured", "mixture") if x in found] or list(found)[:1]):
            generator, sup = _generator(seed, 1, k, j), good.rows[k, name].sup
            findings += material_findings(furnace, case, name, found[name], sup, samples // 4, generator)
    spoiled, bad = _controls(furnace, n, max(samples, _CONTROL_SAMPLES), partition, seed, say)
    findings += control_findings(bad)
    findings += total_only_findings(cases[0].context, partition, samples, seed)
    findings += _model_findings(furnace, seed, say)
    return Outcome(findings, _arrays(cases, good, spoiled, bad, partition))


def _controls(
    furnace: Integrand, n: Sequence[float], samples: int, partition: Partition, seed: int, say: Say
) -> tuple[list[Case], Record]:
    """Samplers that must be rejected, where all of them can be, whatever inclinations were asked for."""
    cases, bad = [], Record()
    for k, (degrees, crossings) in enumerate(((0.0, n[0]), (89.0, n[-1]))):
        ((label, context),) = _contexts(furnace, [degrees], [crossings])
        say(f"furnace: negative controls, {label}")
        cases.append(furnace_case(furnace, context, label, partition))
        for j, (name, control) in enumerate(controls(default_proposals(furnace, context)).items()):
            bad.rows[k, name] = judge_proposal(furnace, cases[-1], control, samples, _generator(seed, 2, k, j))
    return cases, bad


def _model_findings(furnace: Integrand, seed: int, say: Say) -> list[Finding]:
    found: list[Finding] = []
    for name, part in (
        ("energy", lambda: energy_findings(furnace.bsdf)),
        ("known furnace", known_findings),
        ("symmetries", lambda: symmetry_findings(furnace.bsdf, _generator(seed, 3))),
        ("limits", lambda: limit_findings(furnace.bsdf, _generator(seed, 4))),
    ):
        say(f"furnace: {name}")
        found += part()
    return found


def _contexts(furnace: Integrand, inclinations_deg: Sequence[float], n: Sequence[float]) -> list[tuple[str, Context]]:
    """Contexts with the numbers of fibres that the check sets, or with those that the scene has."""
    scattering = furnace.scattering
    found = []
    for degrees in inclinations_deg:
        theta = math.radians(degrees)
        if isinstance(scattering, ConstantScattering) and scattering.from_context:
            found += [(f"θᵣ = {degrees:g}°, n = {x:g}", Context(theta, _PHI_R, x)) for x in n]
        else:
            found.append((f"θᵣ = {degrees:g}°", scattering.hints(Context(theta, _PHI_R))))
    return found


def _generator(seed: int, *path: int) -> torch.Generator:
    """A generator of its own for every part, whatever else is run."""
    state = np.random.SeedSequence([seed, *path]).generate_state(1, np.uint64)
    return torch.Generator().manual_seed(int(state[0] >> 2))


def _arrays(
    cases: list[Case], good: Record, spoiled: list[Case], bad: Record, partition: Partition
) -> dict[str, np.ndarray]:
    value = np.stack([case.nodes.integrate(lambda rule: rule.value)[0].sum(0).numpy() for case in cases])
    return {
        "labels": np.array([case.label for case in cases]),
        "theta_r_deg": np.array([math.degrees(float(case.context.theta_r)) for case in cases]),
        "n": np.array([float(case.context.n) for case in cases]),
        "value": value,
        "ring_edges_deg": np.degrees(partition.theta.numpy()),
        "wedge_edges_deg": np.degrees(partition.phi.numpy()),
        **good.arrays("proposal", len(cases)),
        "control_labels": np.array([case.label for case in spoiled]),
        **bad.arrays("control", len(spoiled)),
    }


__all__ = [
    "Approach",
    "ConstantIntegrand",
    "Draws",
    "FlippedInclination",
    "Folded",
    "MaterialConsistency",
    "NodeDensity",
    "Partition",
    "PartitionNodes",
    "PermutedRings",
    "SampleWeights",
    "ScaledDensity",
    "WeightedCounts",
    "WhiteFurnace",
    "approach",
    "azimuthal_energies",
    "draw",
    "independent_energies",
    "limits",
    "linear_approach",
    "material_consistency",
    "partition_nodes",
    "ring_light",
    "run",
    "sample_weights",
    "single_furnace",
    "single_scattering",
    "symmetries",
    "weighted_counts",
    "white_furnace",
]
