"""The suite: what `check` found, as findings and as histograms for the plots."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
import torch

from dsfit.checks.finding import Finding
from dsfit.checks.independent.chains import size_of, to_omega
from dsfit.checks.independent.comparisons import Comparison
from dsfit.checks.independent.diagnostics import Limits
from dsfit.checks.independent.pointwise import assembly, deviations, exact_integrand
from dsfit.checks.independent.verify import Judged, Verification, check
from dsfit.checks.independent.welch import smallest_p
from dsfit.checks.subject import Outcome, Say, Subject, silent
from dsfit.context import Context
from dsfit.frame import HALF_PI
from dsfit.quality import reference

SUITE = "independent"
_SHARE = 0.1  # least share of |F| in the region that a proposal is judged on
_ERROR = 0.06  # largest standard error in units of the spread: 280 effective samples
_LOG_ERROR = 0.03  # largest relative standard error of an integral
_ASSEMBLY = 1e-9  # rounding in a_f^n and in Gaussians far out
_TABLE = 2e-3  # of N^G's largest value, as DualScattering promises
_POINTS = 1000
_BINS, _PER_BIN = 36, 5


def run(
    subject: Subject,
    *,
    say: Say = silent,
    ensembles: int = 16,
    walkers: int = 32,
    steps: int = 300,
    samples: int = 32_768,
) -> Outcome:
    """Ensembles on |F| of a subject against its quadrature, its BSDF written twice, and all its proposals.

    Args:
        ensembles: independent ensembles, half of them started from the proposals, half uniformly; even, at least 4.
        walkers: of each ensemble; even, at least 8.
        steps: kept steps of every walker, after a third as many of burn-in.
        samples: directions of every proposal.

    Findings: the chains (unclear if they failed, and then all that rests on them), the chains against the quadrature,
    the BSDF against its exact mode and against `assembly` at places of the chains, and for every proposal its
    marginals, its means, and the integral by its bridge.
    """
    known = reference(subject.integrand, subject.context, 1e-5)
    if not float(known.norm) > 0:
        return Outcome([Finding(SUITE, "chains", subject.label, unclear="int |F| is 0, or too small for float64")])
    found = check(
        subject,
        known=known,
        ensembles=ensembles,
        walkers=walkers,
        steps=steps,
        burn_in=max(1, math.ceil(steps / 3)),
        samples=samples,
        say=say,
    )
    say("computing |F| in other ways")
    shown = max(found.proposals, key=lambda name: found.proposals[name].ess, default=None)
    findings = [*findings_of(found, subject.label, samples, shown), *_pointwise(subject, found)]
    return Outcome(findings, _histograms(subject, found, shown))


def findings_of(found: Verification, case: str, samples: int, shown: str | None = None) -> list[Finding]:
    """The statistical findings of a verification; `shown` is the proposal that the plot shows."""
    diagnostics = found.diagnostics
    failed = "chains not converged" if diagnostics.reasons else None
    findings = [
        Finding(
            SUITE,
            "chains",
            case,
            value=diagnostics.r_hat,
            bound=Limits().r_hat,
            unclear="; ".join(diagnostics.reasons) or None,
            detail=diagnostics.line,
            data={**diagnostics.to_dict(), "reasons": list(diagnostics.reasons), "shown": shown},
        ),
        _comparison("chains against quadrature", case, found.quadrature, failed, {}),
    ]
    for name, judged in found.proposals.items():
        findings.extend(_of_proposal(name, judged, found, case, samples, failed))
    return findings


def _of_proposal(
    name: str, judged: Judged, found: Verification, case: str, samples: int, failed: str | None
) -> Iterator[Finding]:
    if judged.not_finite:
        detail = f"{judged.not_finite} samples or places with a density of 0 or not a number"
        yield Finding(SUITE, f"{name}: finite", case, value=float(judged.not_finite), bound=0.0, detail=detail)
        return
    share, ess = judged.region.share, judged.ess
    data = {
        "share": share,
        "ess": ess,
        "ess_in_region": judged.region.ess,
        "tail_index": judged.tail_index,
    }
    small = None
    if share < _SHARE:
        small = f"effective samples {ess:.3g} of {samples}, and only {share:.2%} of |F| where weights are bounded"
    for kind, comparison in (("marginals", judged.marginals), ("means", judged.means)):
        yield _comparison(f"{name}: {kind}", case, comparison, failed or small, data)
    yield _bridge(name, judged, found, case, failed, small, data)


def _comparison(
    subject: str, case: str, comparison: Comparison, unclear: str | None, data: dict[str, object]
) -> Finding:
    error = comparison.relative_error
    if unclear is None and not error <= _ERROR:
        known = f"; effective samples {data['ess']:.3g}" if "ess" in data else ""
        unclear = f"standard error {error:.2g} of the spread, above {_ERROR:g}{known}"
    worst = int(np.argmin(comparison.p))
    judged = f", on {data['share']:.1%} of |F|" if "share" in data else ""
    return Finding(
        SUITE,
        subject,
        case,
        p_value=comparison.p_value,
        unclear=unclear,
        detail=f"worst {comparison.worst}: z = {comparison.z[worst]:.2f}, standard errors up to {error:.2g}{judged}",
        data={**data, "worst": comparison.worst, "z": float(comparison.z[worst]), "relative_error": error},
    )


def _bridge(
    name: str,
    judged: Judged,
    found: Verification,
    case: str,
    failed: str | None,
    small: str | None,
    data: dict[str, object],
) -> Finding:
    bridge, known = judged.bridge, found.reference
    if not math.isfinite(bridge.log_norm):
        unclear = failed or "no place is known to both the proposal and the chains"
        return Finding(SUITE, f"{name}: bridge", case, unclear=unclear, data=data)
    p, z = bridge.against(float(known.norm), float(known.norm_error))
    both = [p] if small or not judged.means.relative_error <= _ERROR else [p, bridge.p_region]
    unclear = failed or (None if known.converged else "the quadrature did not converge")
    if unclear is None and bridge.log_error > _LOG_ERROR:
        unclear = f"relative standard error {bridge.log_error:.2g} > {_LOG_ERROR:g}; effective samples {judged.ess:.3g}"
    ratio, value, error = math.exp(bridge.log_norm), float(known.norm), bridge.importance[1]
    return Finding(
        SUITE,
        f"{name}: bridge",
        case,
        p_value=smallest_p(np.array(both)),
        unclear=unclear,
        detail=f"int |F| / quadrature = {ratio / value:.5f} +- {bridge.log_error:.2g} (z = {z:.2f}), "
        f"by importance sampling {bridge.importance[0] / value:.4f} +- {error:.2g}",
        data={
            **data,
            "z": z,
            "integral": ratio,
            "relative_error": bridge.log_error,
            "quadrature": value,
            "importance": bridge.importance[0],
            "importance_error": error,
            "p_region": bridge.p_region,
        },
    )


def _pointwise(subject: Subject, found: Verification) -> Iterator[Finding]:
    """|F| at places of the chains, by the BSDF's exact mode and by `assembly`."""
    context = subject.context.to(torch.float64)
    place = found.chains.thinned(_POINTS).reshape(-1, 2)[:_POINTS]
    omega = to_omega(place, context)
    with torch.no_grad():
        own = subject.integrand(omega, context).numpy()
        exact = exact_integrand(subject.integrand)
        if exact is not None:
            mean = float(deviations(own, exact(omega, context).numpy()).mean())
            detail = f"mean |F - F_exact| / |F| = {mean:.2g} at {len(place)} places of the chains"
            yield Finding(SUITE, "BSDF against its exact mode", subject.label, value=mean, bound=_TABLE, detail=detail)
    again = assembly(subject.integrand, context, omega)
    if again is not None:
        worst = float(deviations(own, again).max())
        detail = f"largest |F - F again| / |F| = {worst:.2g} at {len(place)} places of the chains"
        yield Finding(SUITE, "BSDF put together again", subject.label, value=worst, bound=_ASSEMBLY, detail=detail)


def _histograms(subject: Subject, found: Verification, shown: str | None) -> dict[str, np.ndarray]:
    """Densities per degree of theta_i and phi: the chains', the quadrature's, and those of the proposal shown."""
    context = subject.context.to(torch.float64)
    chain = found.chains.thinned(10**7).reshape(-1, 2)
    grid = _grid(subject, context)
    arrays: dict[str, np.ndarray] = {}
    for column, (name, reach) in enumerate((("theta", HALF_PI), ("phi", math.pi))):
        edges = np.linspace(-reach, reach, _BINS + 1)
        width = np.degrees(edges[1] - edges[0])
        arrays[f"{name}_edges_deg"] = np.degrees(edges)
        arrays[f"{name}_chains"] = np.histogram(chain[:, column], edges)[0] / len(chain) / width
        arrays[f"{name}_quadrature"] = grid.sum(axis=1 - column).reshape(_BINS, _PER_BIN).sum(axis=1) / width
        if shown is not None:
            drawn = found.weighted[shown]
            top = drawn.log_weight.max()
            weight = np.exp(drawn.log_weight - top) if np.isfinite(top) else np.zeros(len(drawn.place))
            counts = np.histogram(drawn.place[:, column], edges, weights=weight)[0]
            arrays[f"{name}_proposal"] = counts / max(weight.sum(), 1e-300) / width
    return arrays


def _grid(subject: Subject, context: Context) -> np.ndarray:
    """p* in cells of a midpoint rule, `[180, 180]`, that plots compare with; it may miss narrow lobes."""
    middle = (torch.arange(_BINS * _PER_BIN, dtype=torch.float64) + 0.5) / (_BINS * _PER_BIN) * 2 - 1
    theta, phi = torch.meshgrid(HALF_PI * middle, math.pi * middle, indexing="ij")
    place = torch.stack([theta, phi], dim=-1).reshape(-1, 2).numpy()
    size = size_of(subject.integrand, context)(to_omega(place, context)).reshape(theta.shape)
    mass = (size * torch.cos(theta)).numpy()
    return mass / mass.sum()
