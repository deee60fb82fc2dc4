"""One shading point: ensembles of walkers on |F|, a fitted proposal reweighted, and a grid, beside each other."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass
from typing import Any

import emcee
import numpy as np
import torch

from dsfit.bsdf.dual_scattering import DualScattering
from dsfit.checks.independent import (
    Chains,
    Comparison,
    Diagnostics,
    Judged,
    diagnose,
    draw,
    judge_proposal,
    run_ensembles,
    size_of,
)
from dsfit.checks.independent.chains import Size, to_omega, to_place
from dsfit.checks.independent.comparisons import against_quadrature
from dsfit.checks.independent.diagnostics import traces
from dsfit.checks.independent.welch import Sample
from dsfit.context import Context
from dsfit.fit import fit
from dsfit.proposals.base import Proposal
from dsfit.proposals.structured import StructuredProposal
from dsfit.quality import Reference, excess, quadrature_nodes, reference
from dsfit.random import uniforms
from dsfit.scene.integrand import Integrand
from experiments._emcee_marginals import Grid, joint, marginals

_PLACES = 65_536


@dataclass(frozen=True)
class Sizes:
    """How much is drawn: see `run_ensembles`; `samples` of the proposal."""

    ensembles: int
    walkers: int
    steps: int
    burn_in: int
    samples: int
    fit_steps: int


@dataclass(frozen=True)
class Cell:
    """What was found at a point: arrays and numbers by name."""

    arrays: dict[str, np.ndarray]
    numbers: dict[str, Any]


@dataclass(frozen=True)
class Walk:
    """What is known at a point before any proposal is judged.

    Attributes:
        integrand, context, fitted, chains, known, diagnostics, grid: by their names; `fitted` is where half of the
            ensembles started.
        quadrature: smooth means of the chains against those of the quadrature.
        seconds: of the fit and of the chains.
    """

    integrand: Integrand
    context: Context
    fitted: Proposal
    chains: Chains
    known: Reference
    diagnostics: Diagnostics
    grid: Grid
    quadrature: Comparison
    seconds: dict[str, float]


def walk(bsdf: DualScattering, context: Context, sizes: Sizes, seed: int) -> Walk:
    """Fit a proposal, run the ensembles and the quadratures.

    Args:
        bsdf: in a furnace.
        context: a single one.
        sizes: how much is drawn.
        seed: of the chains.
    """
    integrand, clock = Integrand(bsdf), _Clock()
    fitted = fit(StructuredProposal(bsdf, context), integrand, context, max_steps=sizes.fit_steps).proposal
    assert isinstance(fitted, Proposal)
    seconds = {"fit": clock.lap()}
    size = size_of(integrand, context)
    options = {name: getattr(sizes, name) for name in ("ensembles", "walkers", "steps", "burn_in")}
    chains = run_ensembles(size, context, [fitted], **options, seed=seed)
    seconds["chains"] = clock.lap()
    nodes = quadrature_nodes(integrand, context, 1e-3, count=10)
    share, at = (nodes.weight * nodes.norm).numpy(), to_place(nodes.omega, context)
    share = share / share.sum()
    diagnostics = diagnose(chains, (at, np.log(nodes.norm.numpy()), share))
    known, grid = reference(integrand, context, 1e-6), Grid.of(size, context)
    quadrature = against_quadrature(chains, at, share)
    return Walk(integrand, context, fitted, chains, known, diagnostics, grid, quadrature, seconds)


def compare(found: Walk, law: Proposal, samples: int, seed: int, maps: bool = False) -> Cell:
    """A proposal's weighted samples against the walkers.

    Args:
        found: the walkers.
        law: the proposal.
        samples: its directions.
        seed: of them.
        maps: whether chains and |F| over (theta_i, phi) are kept.
    """
    chains, context, diagnostics, known = found.chains, found.context, found.diagnostics, found.known
    size, clock = size_of(found.integrand, context), _Clock()
    _weights(law, size, context, samples, seed)
    seconds = found.seconds | {"samples": clock.lap()}
    place = chains.thinned(_PLACES)
    log_size = np.log(size(to_omega(place.reshape(-1, 2), context)).numpy()).reshape(place.shape[:2])
    drawn = draw(law(context), size, context, place, log_size, samples, seed)
    norm, bound = float(known.norm), float(known.norm_error)
    judged = judge_proposal(drawn, place, log_size, norm, diagnostics)
    tau, tau_error = autocorrelation(chains)
    accepted, accepted_error = acceptance(chains)
    # how often which move was made is common to all ensembles, and tau falls as acceptance rises
    tau_error = math.hypot(tau_error, tau * accepted_error / accepted)
    numbers = {
        **_numbers(chains, diagnostics, judged, norm, bound),
        "acceptance": accepted,
        "acceptance_error": accepted_error,
        "tau": tau,
        "tau_error": tau_error,
        "excess": float(excess(found.integrand, law, context, 1e-2).value),
        "grid_gap": abs(found.grid.norm / norm - 1),
        "chain_evaluations": chains.log_size.size,
        "burn_in_evaluations": (chains.burn_in + 1) * chains.ensembles * chains.place.shape[2],
        "ensembles": chains.ensembles,
        "samples": samples,
        "seconds": seconds,
        "p": {
            "chains_quadrature": found.quadrature.p_value,
            "marginals": judged.marginals.p_value,
            "means": judged.means.p_value,
            "bridge": judged.bridge.against(norm, bound)[0],
        },
    }
    effective = min(diagnostics.bulk_ess, diagnostics.between_ess)
    arrays = marginals(chains, drawn, found.grid, effective)
    return Cell(arrays | (joint(chains, found.grid) if maps else {}), numbers)


class _Clock:
    """Seconds of processor time between laps."""

    def __init__(self) -> None:
        self.last = time.process_time()

    def lap(self) -> float:
        """Since the last one."""
        now = time.process_time()
        found, self.last = now - self.last, now
        return found


def _weights(law: Proposal, size: Size, context: Context, samples: int, seed: int) -> torch.Tensor:
    """What importance sampling takes: directions, densities and |F|."""
    with torch.no_grad():
        distribution = law(context)
        u = uniforms((samples,), distribution.dimension, generator=torch.Generator().manual_seed(seed))
        omega, log_p = distribution.sample_with_log_prob(u)
        return size(omega) / torch.exp(log_p)


def acceptance(chains: Chains) -> tuple[float, float]:
    """Share of accepted steps and its standard error, from the scatter between steps: all ensembles make the same kind
    of move in a step, and kinds differ in how often they are accepted, so that ensembles scatter too little."""
    moved = (np.diff(chains.place, axis=0) != 0).any(axis=-1).mean(axis=(1, 2))
    found = Sample.of_independent(moved)
    return float(found.mean), math.sqrt(float(found.variance))


def autocorrelation(chains: Chains) -> tuple[float, float]:
    """emcee's integrated autocorrelation time in steps, of the function that has the longest, mean over ensembles with
    its standard error.

    Sokal's window (c = 5) on each ensemble's walkers. emcee takes every walker about its own mean, which makes tau look
    shorter, by some 10 tau^2 / steps: `Diagnostics.autocorrelation` is about the mean of all.
    """
    best = (0.0, 0.0)
    for trace in traces(chains).values():
        times = [
            float(emcee.autocorr.integrated_time(x[:, :, None], tol=0, quiet=True)[0]) for x in trace.transpose(1, 0, 2)
        ]
        found = Sample.of_independent(np.array(times))
        best = max(best, (float(found.mean), math.sqrt(float(found.variance))))
    return best


def _numbers(
    chains: Chains, diagnostics: Diagnostics, judged: Judged, norm: float, norm_error: float
) -> dict[str, Any]:
    scatter = math.sqrt(2 / (chains.ensembles - 1))  # of a variance between so many
    bridge = judged.bridge
    return {
        "r_hat": diagnostics.r_hat,
        "nested_r_hat": diagnostics.nested_r_hat,
        "autocorrelation": diagnostics.autocorrelation,
        "bulk_ess": diagnostics.bulk_ess,
        "between_ess": diagnostics.between_ess,
        "between_ess_error": diagnostics.between_ess * scatter,
        "reasons": list(diagnostics.reasons),
        "proposal_ess": judged.ess,
        "tail_index": judged.tail_index,
        "region": judged.region.share,
        "quadrature": norm,
        "quadrature_bound": norm_error,
        "bridge": math.exp(bridge.log_norm),
        "bridge_error": math.exp(bridge.log_norm) * bridge.log_error,
        "importance": bridge.importance[0],
        "importance_error": bridge.importance[0] * bridge.importance[1],
    }
