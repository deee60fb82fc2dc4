"""Chains on |F|, the quadrature, and every proposal of a subject against them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
import torch

from dsfit.checks.independent.chains import Chains, Size, run_ensembles, size_of, to_omega, to_place
from dsfit.checks.independent.comparisons import (
    Bridge,
    Comparison,
    Region,
    against_quadrature,
    bridge,
    marginals,
    means,
    region,
)
from dsfit.checks.independent.diagnostics import Diagnostics, Limits, diagnose
from dsfit.checks.independent.resampling import Weighted, draw
from dsfit.checks.subject import Say, Subject, silent
from dsfit.context import Context
from dsfit.quality import Nodes, Reference, quadrature_nodes, reference

_MOST = 65_536  # places of the chains that proposals are asked about
_LIMIT = 50.0  # largest weight, in units of int |F|, of what a proposal is judged on


@dataclass(frozen=True)
class Judged:
    """What was found about one proposal."""

    region: Region
    ess: float
    tail_index: float
    marginals: Comparison
    means: Comparison
    bridge: Bridge
    not_finite: int


@dataclass(frozen=True)
class Verification:
    """Chains, their diagnostics, the quadrature and its comparison with the chains, and every proposal's."""

    chains: Chains
    diagnostics: Diagnostics
    reference: Reference
    nodes: Nodes
    quadrature: Comparison
    proposals: Mapping[str, Judged] = field(default_factory=dict)
    weighted: Mapping[str, Weighted] = field(default_factory=dict)


def check(
    subject: Subject,
    *,
    target: Size | None = None,
    known: Reference | None = None,
    ensembles: int = 16,
    walkers: int = 32,
    steps: int = 300,
    burn_in: int = 100,
    samples: int = 32_768,
    limits: Limits | None = None,
    say: Say = silent,
) -> Verification:
    """Ensembles on |F|, or on `target` (a second implementation of it, up to a factor), and all comparisons.

    Args:
        known: the subject's reference, if it is known already.
        ensembles, walkers, steps, burn_in: see `run_ensembles`.
        samples: directions of each proposal.
    """
    context = subject.context.to(torch.float64)
    own = size_of(subject.integrand, context)
    size = own if target is None else target
    say("running ensembles")
    chains = run_ensembles(
        size,
        context,
        list(subject.proposals.values()),
        ensembles=ensembles,
        walkers=walkers,
        steps=steps,
        burn_in=burn_in,
        seed=subject.seed,
    )
    known = reference(subject.integrand, context, 1e-5) if known is None else known
    nodes = quadrature_nodes(subject.integrand, context, 1e-3, count=10)
    shares = _shares(nodes, size, context)
    diagnostics = diagnose(chains, shares, limits)
    mass = (nodes.weight * nodes.norm).numpy()
    place = chains.thinned(_MOST)
    with np.errstate(divide="ignore"):
        log_size = np.log(own(to_omega(place.reshape(-1, 2), context)).numpy()).reshape(place.shape[:2])
    found, drawn = {}, {}
    for index, (name, proposal) in enumerate(subject.proposals.items()):
        say(f"comparing {name}")
        law = proposal(context)
        drawn[name] = draw(law, own, context, place, log_size, samples, subject.seed + 7919 * (index + 1))
        found[name] = judge_proposal(drawn[name], place, log_size, float(known.norm), diagnostics)
    return Verification(
        chains,
        diagnostics,
        known,
        nodes,
        against_quadrature(chains, to_place(nodes.omega, context), mass / mass.sum()),
        found,
        drawn,
    )


def judge_proposal(
    weighted: Weighted, place: np.ndarray, log_size: np.ndarray, norm: float, diagnostics: Diagnostics
) -> Judged:
    """All comparisons of one proposal's samples with the ensembles' places `[E, n, 2]`, log |F| there `[E, n]`."""
    bad = int(np.isnan(weighted.log_weight).sum() + np.isposinf(weighted.log_weight).sum())
    bad += int(np.isnan(weighted.other_log_weight).sum())
    where = region(weighted, math.log(norm), _LIMIT)
    effective_samples = min(diagnostics.bulk_ess, diagnostics.between_ess, place.shape[0] * place.shape[1])
    return Judged(
        region=where,
        ess=weighted.ess,
        tail_index=weighted.tail_index,
        marginals=marginals(weighted, place, log_size, where),
        means=means(weighted, place, where),
        bridge=bridge(weighted, where, effective_samples),
        not_finite=bad,
    )


def _shares(nodes: Nodes, size: Size, context: Context) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The quadrature's nodes with the density that the chains ran on: places, log |F|, shares of p*."""
    value = size(nodes.omega)
    mass = (nodes.weight * value).numpy()
    with np.errstate(divide="ignore"):
        return to_place(nodes.omega, context), np.log(value.numpy()), mass / mass.sum()
