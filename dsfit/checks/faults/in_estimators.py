"""Faults in quadrature, MIS, fits and the interface to renderers."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from dsfit.checks.faults import looks
from dsfit.checks.faults.planting import Fault, Patch, changed
from dsfit.checks.finding import Finding
from dsfit.checks.unbiased import z_test
from dsfit.context import Context
from dsfit.proposals.base import Proposal


def _lobes() -> dict[str, Proposal]:
    from dsfit.proposals import chapter_proposals

    found = chapter_proposals(looks.bsdf(), learnable=False)
    return {name: found[name] for name in ("R", "TT", "TRT")}


def _moment(seed: int) -> list[Finding]:
    """The second moment by quadrature against its estimate from samples."""
    from dsfit.proposals import StructuredProposal
    from dsfit.quality import excess, reference
    from dsfit.random import uniforms
    from dsfit.scene.integrand import Integrand

    context = Context(looks.THETA_R, looks.PHI_R)
    integrand = Integrand(looks.bsdf())
    proposal = StructuredProposal(integrand.bsdf, context, defensive=0.1)
    with torch.no_grad():
        distribution, generator = proposal(context), torch.Generator().manual_seed(seed)
        u = uniforms((100_000,), distribution.dimension, generator=generator, dtype=torch.float64)
        omega, log_prob = distribution.sample_with_log_prob(u)
        weight = torch.linalg.vector_norm(integrand(omega, context), dim=-1) * torch.exp(-log_prob)
        norm = float(reference(integrand, context, 1e-6).norm)
        claimed = float(excess(integrand, proposal, context).value)
    squares = (weight / norm) ** 2
    return [Finding("unbiased", "excess", "quadrature against samples", p_value=z_test(squares, 1 + claimed))]


def _fit(seed: int) -> list[Finding]:
    """A fit that starts near an optimum which is known: the target is one of the family."""
    from dsfit.fit.fit import fit
    from dsfit.proposals import StructuredProposal
    from dsfit.quality import excess
    from dsfit.scene.integrand import Integrand

    context = Context(looks.THETA_R, looks.PHI_R)
    integrand = Integrand(looks.bsdf())
    start = StructuredProposal(integrand.bsdf, context)
    before = float(excess(integrand, start, context).value)
    found = fit(start, integrand, context, max_steps=15, seed=seed)
    after = float(excess(integrand, found.proposal, context).value)
    return [
        Finding("gradients", "fit", "lowers the excess", value=after / before, bound=0.7),
        Finding("gradients", "fit", "states its excess", value=abs(found.excess / after - 1), bound=0.05),
    ]


def _material(seed: int) -> list[Finding]:
    """`f`, `sample_f` and `pdf` of a material against each other."""
    from dsfit.frame import to_vector
    from dsfit.material import Material
    from dsfit.proposals import StructuredProposal
    from dsfit.quality import reference
    from dsfit.random import uniforms

    context = Context(looks.THETA_R, looks.PHI_R)
    bsdf = looks.bsdf()
    material = Material(bsdf, StructuredProposal(bsdf, context, defensive=0.1))
    wo = to_vector(torch.stack([context.theta_r, context.phi_r]))
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        u = uniforms((40_000,), material.proposal(context).dimension, generator=generator, dtype=torch.float64)
        found = material.sample_f(wo, u)
        weight = (found.f * (found.wi[..., 1].abs() / found.pdf).unsqueeze(-1)).mean(-1)
        truth = float(reference(material._integrand, context, 1e-6).value.mean())
    return [Finding("furnace", "material", "white furnace", p_value=z_test(weight, truth))]


def _equal_power(log_weights: Any) -> Any:
    """Squared densities over the sum of densities."""

    def wrong(self: Any, log_p: Tensor, counts: Tensor) -> Tensor:
        return log_weights(self, log_p, counts) + 0.02 * log_p.clamp(-5, 5)

    return wrong


def _turned(register: Any) -> Any:
    """The Jacobian with its sign turned."""

    def wrong(fn: Any, jacobian: Any = None) -> int:
        from dsfit.fit.bridge import value_and_jacobian

        def turned(y: Tensor) -> tuple[Tensor, Tensor]:
            value, slopes = value_and_jacobian(fn, y) if jacobian is None else jacobian(y)
            return value, -slopes

        return register(fn, turned)

    return wrong


ESTIMATOR_FAULTS = (
    Fault(
        "mis-weights", "dsfit.mis.heuristics", "weights of the power heuristic that do not sum to one",
        (Patch("dsfit.mis.heuristics:Power.log_weights", _equal_power),), "unbiased",
        looks.estimating(_lobes, heuristics=("power",)),
    ),
    Fault(
        "mis-combine", "dsfit.mis.estimators", "contributions of samples two per cent too large",
        (Patch("dsfit.mis.estimators:contribution", changed(lambda z, *_: z * 1.02)),), "unbiased",
        looks.estimating(_lobes),
    ),
    Fault(
        "cubature-map", "dsfit.cubature", "one per cent too much weight in the azimuth map of the quadrature",
        (Patch("dsfit.cubature:nodes_of", changed(lambda r, *_: (r[0], r[1], r[2] * 1.01))),), "unbiased",
        looks.estimating(_lobes),
    ),
    Fault(
        "gauss-weights", "dsfit.quadrature", "Gauss weights of the wrong sum",
        (Patch("dsfit.quadrature:gauss_legendre", changed(lambda r, *_: (r[0], r[1] * 1.01))),), "furnace",
        looks.energy(),
    ),
    Fault(
        "excess-norm", "dsfit.quality", "an excess that is 0.5 too large",
        (Patch("dsfit.quality:_excess_one", changed(lambda r, *_: (r[0] + 0.5, *r[1:]))),), "unbiased", _moment,
    ),
    Fault(
        "bridge-sign", "dsfit.fit.bridge", "the Jacobian handed to JAX with its sign turned",
        (Patch("dsfit.fit.bridge:register", _turned),), "gradients", _fit,
    ),
    Fault(
        "objective-half", "dsfit.fit.objectives", "residuals of the excess over p^(1/4) for p^(1/2)",
        (Patch("dsfit.fit.objectives:excess_residuals", changed(lambda r, log_p, *_: r * torch.exp(0.25 * log_p))),),
        "gradients", _fit,
    ),
    Fault(
        "material-cosine", "dsfit.material", "|n . wi| divided out where the fibre's own cosine belongs",
        (Patch("dsfit.material:_cos_normal",
               changed(lambda r, wi: torch.sqrt((1 - wi[..., 0] ** 2).clamp_min(1e-12)))),),
        "furnace", _material,
    ),
)  # fmt: skip
