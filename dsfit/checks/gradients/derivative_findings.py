"""Findings of the suite `gradients` about derivatives."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import torch
from torch import Tensor

from dsfit.checks.finding import Finding
from dsfit.checks.gradients import functions as fn
from dsfit.checks.gradients.compare import MODES_AGREE, DerivativeCheck, Function, check_derivative
from dsfit.checks.gradients.formulas import FormulaCheck, check_formulas
from dsfit.checks.gradients.moment import learnable
from dsfit.checks.gradients.second_order import SecondOrder, second_derivatives
from dsfit.checks.gradients.through_fit import derivatives_through_fit, fiber_family, nodes_of_family
from dsfit.checks.subject import Say, Subject
from dsfit.fit.objectives import Excess, Target
from dsfit.fit.proposal_problem import Parameters, ProposalProblem
from dsfit.proposals import Mixture, chapter_proposals
from dsfit.proposals.base import Proposal
from dsfit.quality import quadrature_nodes

SUITE = "gradients"
MOST_UNCLEAR = 0.25
"""Share of points where differences may say nothing before a derivative counts as not checked."""


def finding_of(check: DerivativeCheck, function: str, case: str) -> Finding:
    """Deviation from the differences over their tolerance, and of the modes from each other; the larger one counts."""
    value = max(check.worst, check.apart / MODES_AGREE)
    unclear = None
    if check.unclear_share > MOST_UNCLEAR:
        unclear = (
            f"differences tell nothing at {check.unclear_share:.0%} of the points: kinks, jumps or narrow features"
        )
    seen = f"errors above {check.sharpness:.0e} would be seen"
    if not bool((check.numeric.abs() > 0).any()):
        seen = "zero at all points"
    modes = f"no forward mode: {check.refused}" if check.forward is None else f"both modes within {check.apart:.1e}"
    return Finding(
        SUITE,
        f"{function} in {check.name}",
        case,
        value=value,
        bound=1.0,
        unclear=unclear,
        detail=f"{seen}; {modes}",
        data={"unclear_share": check.unclear_share, "sharpness": check.sharpness, "apart": check.apart},
    )


def derivative_findings(subject: Subject, points: int, averages: bool, say: Say) -> list[Finding]:
    """Derivatives of formulas, the BSDF, and every proposal."""
    generator = torch.Generator().manual_seed(subject.seed)
    bsdf, case = subject.integrand.bsdf, subject.label
    found: list[Finding] = []

    def take(function: str, checks: Iterable[DerivativeCheck]) -> None:
        found.extend(finding_of(check, function, case) for check in checks)

    say("derivatives of formulas")
    found += [_formula_finding(x, case) for x in check_formulas(subject.seed)]
    say("derivatives of the BSDF")
    take("BSDF", fn.bsdf_in_directions(bsdf, fn.directions(8 * points, generator)))
    few = fn.directions(max(4, points // 2), generator)
    take("BSDF", fn.bsdf_in_fiber(bsdf, few))
    if averages:
        say("derivatives of the averages")
        take("BSDF with averages", fn.bsdf_in_averages(bsdf, few, subject.seed))
    nodes = quadrature_nodes(subject.integrand, subject.context, 1e-2, count=3)
    target = Target.from_nodes(subject.context, nodes.omega, nodes.weight, nodes.value)
    twice: dict[str, dict[str, SecondOrder]] = {"log p": {}, "sampler": {}, "BSDF": {"phi": _bsdf_twice(subject, few)}}
    for name, given in subject.proposals.items():
        say(f"derivatives of {name}")
        for function, checks in proposal_checks(learnable(given), target, points, generator, subject.seed):
            take(f"{name} {function}", checks)
        found += _further(learnable(given), name, target, points, generator, case)
        for function, second in proposal_twice(learnable(given), target, points, generator).items():
            twice[function][name] = second
    return [*found, *(_twice_finding(function, rows, case) for function, rows in twice.items() if rows)]


def _formula_finding(x: FormulaCheck, case: str) -> Finding:
    refused = f"; no complex step: {x.refused}" if x.refused else ""
    return Finding(SUITE, x.name, case, value=x.worst, bound=1e-12, detail=f"by {x.method}{refused}")


def draws(proposal: Proposal, target: Target, points: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Uniforms `[points, d]` away from their ends, and directions `[points, 2]` with a finite density."""
    with torch.no_grad():
        distribution = proposal(target.context)
        size = (points, distribution.dimension)
        u, other = (0.01 + 0.98 * torch.rand(size, generator=generator, dtype=torch.float64) for _ in range(2))
        return u, distribution.sample(other)


def proposal_checks(
    proposal: Proposal, target: Target, points: int, generator: torch.Generator, seed: int = 0
) -> Iterator[tuple[str, Iterable[DerivativeCheck]]]:
    """Function by name, and its derivatives: density, sampler and excess of one proposal, in all that they depend on.

    Args:
        proposal: what requires grad is differentiated in.
        target: nodes of one context.
        points: directions and uniforms.
        generator: of those.
        seed: of random directions among parameters.
    """
    context = target.context
    u, omega = draws(proposal, target, points, generator)
    yield "log p", fn.in_parameters(fn.log_prob_of(proposal, context, omega), proposal, seed=seed)
    yield "log p", fn.density_in_directions(proposal, context, omega)
    yield "log p", fn.density_in_context(proposal, context, omega)
    yield "sampler", fn.in_parameters(fn.vectors_of(proposal, context, u), proposal, seed=seed)
    yield "sampler", fn.sampler_in_uniforms(proposal, context, u)
    yield "excess", fn.in_parameters(fn.excess_of(proposal, target), proposal, seed=seed)


def _further(
    proposal: Proposal, name: str, target: Target, points: int, generator: torch.Generator, case: str
) -> Iterator[Finding]:
    """What fits use in place of automatic differentiation, and a planted fault."""
    learned = [key for key, p in proposal.named_parameters() if p.requires_grad]
    if not learned:
        return
    _, omega = draws(proposal, target, points, generator)
    values = {key: p.detach() for key, p in proposal.named_parameters()}
    log_prob = fn.log_prob_of(proposal, target.context, omega)
    _, own = proposal.log_prob_with_jacobian(target.context, omega)
    gap = 0.0
    for key in learned:
        leaf = values[key].clone().requires_grad_()
        flat = log_prob({**values, key: leaf})
        rows = torch.autograd.grad(flat, leaf, torch.eye(len(flat), dtype=flat.dtype), is_grads_batched=True)[0]
        size = 1 + rows.abs().amax()
        gap = max(gap, float(((own[key].reshape(rows.shape) - rows).abs() / size).max()))
    yield Finding(SUITE, f"{name} log_prob_with_jacobian", case, value=gap / MODES_AGREE, bound=1.0)
    yield _gauss_newton(proposal, name, target, case)
    key = learned[-1]
    fault = check_derivative(_slightly_wrong(log_prob), values, key, at_once=fn.batches(log_prob, values, key))
    yield Finding(
        SUITE, f"{name} control: one part in 1e5", case, value=1 / max(fault.worst, 1e-300), bound=1e-2,
        unclear=None if float(fault.numeric.abs().nan_to_num().max()) > 1e-6 else "the derivative is zero",
    )  # fmt: skip


def _slightly_wrong(function: Function) -> Function:
    def wrong(values: dict[str, Tensor]) -> Tensor:
        value = function(values)
        return value + 1e-5 * (value - value.detach())

    return wrong


def _gauss_newton(proposal: Proposal, name: str, target: Target, case: str) -> Finding:
    """2 J^T r of the compressed system that least-squares solvers see, against the gradient by reverse mode."""
    problem = ProposalProblem(proposal, [target], Excess(), jacobian="own")
    y = Parameters(proposal).vector(proposal)
    residuals, jacobian = problem.linearise(y)
    _, gradient = problem.gradient(y)
    size = 2 * jacobian.norm(dim=0) * residuals.norm() + 1e-300
    gap = float(((2 * jacobian.T @ residuals - gradient).abs() / size).max())
    return Finding(SUITE, f"{name} Gauss-Newton gradient", case, value=gap / MODES_AGREE, bound=1.0)


def proposal_twice(
    proposal: Proposal, target: Target, points: int, generator: torch.Generator
) -> dict[str, SecondOrder]:
    """Second derivatives of the density and of the sampler in the last parameter; nothing without parameters."""
    learned = [key for key, p in proposal.named_parameters() if p.requires_grad]
    if not learned:
        return {}
    u, omega = draws(proposal, target, points, generator)
    values = {key: p.detach() for key, p in proposal.named_parameters()}
    functions = {
        "log p": fn.log_prob_of(proposal, target.context, omega),
        "sampler": fn.vectors_of(proposal, target.context, u),
    }
    return {name: second_derivatives(function, values, learned[-1]) for name, function in functions.items()}


def _bsdf_twice(subject: Subject, at: dict[str, Tensor]) -> SecondOrder:
    exact = subject.integrand.bsdf.replace(precision="exact", d_b=0.0)
    return second_derivatives(lambda v: exact.direct(at["theta_i"], at["theta_r"], v["phi"]), at, "phi")


def _twice_finding(function: str, rows: dict[str, SecondOrder], case: str) -> Finding:
    """Densities have second derivatives; samplers and the BSDF carry first derivatives alone, and nothing asks for
    more: where theirs are wrong, that is said, and is no failure."""
    missing = {name: row.status for name, row in rows.items() if row.status != "agrees"}
    unclear = None
    if missing and function != "log p":
        unclear = "first derivatives only, as documented; second ones: " + ", ".join(
            f"{k} {v}" for k, v in missing.items()
        )
    worst = max(row.check.worst for row in rows.values())
    detail = f"{len(rows) - len(missing)} of {len(rows)} agree with differences of the gradient"
    return Finding(
        SUITE, f"{function}, second derivatives", case, value=worst, bound=1.0, unclear=unclear, detail=detail
    )


def fit_findings(subject: Subject) -> list[Finding]:
    """First-order condition, envelope theorem and implicit function theorem at a fit of three lobes to single
    scattering, in the width of TT."""
    context, case = subject.context, subject.label
    fiber = subject.integrand.bsdf.fiber
    family = fiber_family(subject.integrand, context, "beta", 1)
    nodes = nodes_of_family(subject.integrand, family, context)
    lobes = chapter_proposals(fiber)
    proposal = Mixture([lobes[name] for name in ("R", "TT", "TRT")], defensive=0.05)
    found = derivatives_through_fit(proposal, family, nodes, context)
    excess, parameters = found.worst
    slopes = f"envelope {found.implicit:.9f}, refitted {float(found.refitted.value):.9f}"
    rows = (
        ("first-order condition", found.alignment / 1e-5, f"cosine of residuals and tangents {found.alignment:.1e}"),
        ("gain left by Newton's method", found.gain / 1e-8, f"{found.gain:.1e} of the excess {found.excess:.4f}"),
        ("fitted excess in the width of TT", excess, slopes),
        ("fitted parameters in the width of TT", parameters, f"{len(found.implicit_parameters)} of them, implicit"),
    )
    findings = [Finding(SUITE, f"fit: {name}", case, value=v, bound=1.0, detail=d) for name, v, d in rows]
    if not bool(found.refitted.error <= 1e-2 * found.refitted.value.abs()):
        findings[2:] = [
            Finding(SUITE, f.subject, case, unclear="refits differ by too much noise") for f in findings[2:]
        ]
    return findings
