"""Derivatives through a fit: of the least excess, and of the fitted parameters, in a parameter of the fibre.

With E(y, x) the excess on fixed quadrature nodes, y the proposal's parameters and x the fibre's, y*(x) = argmin E and
e(x) = E(y*(x), x),

    dE/dy = 0                                    at y*, the first-order condition,
    de/dx = dE/dx at fixed y                     (envelope theorem),
    dy*/dx = -(d2E/dy2)^-1 d2E/dy dx             (implicit function theorem),

each of which is compared with differences of fits at neighbouring x.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from dsfit.bsdf import Fiber
from dsfit.checks.gradients.differences import SAFETY, Difference, derivative
from dsfit.checks.gradients.functions import log_prob_of
from dsfit.context import Context
from dsfit.fit.fit import fit
from dsfit.fit.objectives import Excess, Target, excess_residuals
from dsfit.fit.proposal_problem import Parameters, ProposalProblem
from dsfit.proposals.base import Proposal
from dsfit.quality import Nodes, quadrature_nodes
from dsfit.scene.integrand import Integrand

_NEWTON_STEPS = 8


@dataclass(frozen=True)
class FitDerivatives:
    """What `derivatives_through_fit` found.

    Attributes:
        excess: e(x).
        alignment: cosine between the residuals and the tangent space of the model where the library's fit ended; 0
            at an optimum.
        gain: relative decrease of E that Newton's method still finds there.
        implicit: de/dx by the envelope theorem.
        refitted: de/dx by differences of fits.
        implicit_parameters: dy*/dx `[P]` by the implicit function theorem, within the directions that the density
            depends on.
        refitted_parameters: the same by differences of fits.
    """

    excess: float
    alignment: float
    gain: float
    implicit: float
    refitted: Difference
    implicit_parameters: Tensor
    refitted_parameters: Difference

    @property
    def worst(self) -> tuple[float, float]:
        """Deviations of de/dx and of dy*/dx over what the differences can tell (20 times their error)."""
        return (
            _over(torch.tensor(self.implicit, dtype=torch.float64), self.refitted),
            _over(self.implicit_parameters, self.refitted_parameters),
        )


def _over(value: Tensor, found: Difference) -> float:
    limit = SAFETY * found.error + 1e-10 * (found.value.abs().max() + value.abs().max())
    return float(((value - found.value).abs() / limit).nan_to_num(nan=torch.inf).max())


def fiber_family(
    integrand: Integrand, context: Context, field: str, element: int = 0
) -> Callable[[Tensor, Tensor], Tensor]:
    """`(omega, t) -> F` with element `element` of the fibre's `field` scaled by e^t: single scattering by exact
    azimuths, all light direct, under the integrand's own light."""
    bsdf = integrand.bsdf
    base = bsdf.fiber.to(torch.float64)
    value = base.parameters()[field]
    unit = torch.zeros(value.numel(), dtype=torch.float64)
    unit[element] = 1.0

    def family(omega: Tensor, t: Tensor) -> Tensor:
        fiber: Fiber = base.replace(**{field: value * torch.exp(t * unit.reshape(value.shape))})
        single = Integrand(bsdf.replace(fiber=fiber, d_b=0.0, precision="exact"), light=integrand.light)
        return single(omega, Context(context.theta_r, context.phi_r))

    return family


def derivatives_through_fit(
    proposal: Proposal,
    family: Callable[[Tensor, Tensor], Tensor],
    nodes: Nodes,
    context: Context,
    *,
    step: float = 0.1,
    levels: int = 5,
    solver: str = "torch.lbfgs",
) -> FitDerivatives:
    """Fit at t = 0, differentiate implicitly, and compare with fits at other t.

    The library's `fit` finds the optimum; neighbouring optima are found from it by Newton's method to rounding, so that
    their differences are sharp.

    Args:
        proposal: with learnable parameters.
        family: `(omega [Q, 2], t) -> F [Q, C]`, differentiable in t.
        nodes: of the integrand at t = 0.
        context: a single context.
        step: largest |t|.
        levels: of the extrapolation.
        solver: of the library's fit.
    """
    found = fit(proposal, None, context, nodes=nodes, solver=solver, tolerance=1e-12, max_steps=300)
    fitted = found.proposal
    parameters = Parameters(fitted)
    log_prob = log_prob_of(fitted, context, nodes.omega)
    y0 = parameters.vector(fitted)

    def best_of(t: Tensor) -> Tensor:
        size = torch.linalg.vector_norm(family(nodes.omega, t), dim=-1)
        return torch.log(size) - torch.log((nodes.weight * size).sum())

    def objective(y: Tensor, log_best: Tensor) -> Tensor:
        return excess_residuals(log_prob(parameters.split(y)), nodes.weight, log_best).square().sum()

    zero = torch.zeros((), dtype=torch.float64)
    with torch.no_grad():
        before = float(objective(y0, best_of(zero)))
    start, value = _newton(objective, y0, best_of(zero))
    gain = (before - float(value)) / before

    def refit(t: Tensor) -> Tensor:
        y, value = _newton(objective, start, best_of(t))
        return torch.cat([value.reshape(1), y])

    both = derivative(refit, step, levels=levels)
    rows = (0, slice(1, None))
    first, rest = (Difference(*(x[k] for x in (both.value, both.error, both.noise, both.scale))) for k in rows)
    t, y = zero.clone().requires_grad_(), start.clone().requires_grad_()
    by_t, by_y = torch.autograd.grad(objective(y, best_of(t)), (t, y), create_graph=True)
    mixed = torch.stack([torch.autograd.grad(g, t, retain_graph=True)[0] for g in by_y])
    moved = -_solve(_hessian(by_y, y), mixed.detach())
    return FitDerivatives(
        before, _alignment(fitted, nodes, context, y0), gain, float(by_t.detach()), first, moved, rest
    )


def _hessian(gradient: Tensor, y: Tensor) -> Tensor:
    rows = torch.eye(len(y), dtype=y.dtype)
    return torch.autograd.grad(gradient, y, rows, retain_graph=True, is_grads_batched=True)[0].detach()


def _solve(matrix: Tensor, right: Tensor) -> Tensor:
    """Least-norm solution: shifting all logits of a mixture changes nothing, and is no direction of the fit."""
    return torch.linalg.pinv(matrix, rtol=1e-10, hermitian=True) @ right


def _newton(objective: Callable[[Tensor, Tensor], Tensor], y: Tensor, log_best: Tensor) -> tuple[Tensor, Tensor]:
    """The optimum near y, and its value; the steps square the error, so none is needed after one below 1e-8."""
    log_best = log_best.detach()
    for _ in range(_NEWTON_STEPS):
        leaf = y.detach().clone().requires_grad_()
        with torch.enable_grad():
            (gradient,) = torch.autograd.grad(objective(leaf, log_best), leaf, create_graph=True)
        change = _solve(_hessian(gradient, leaf), gradient.detach())
        y = leaf.detach() - change
        if float(change.abs().max()) < 1e-8:
            break
    with torch.no_grad():
        return y, objective(y, log_best)


def _alignment(proposal: nn.Module, nodes: Nodes, context: Context, y: Tensor) -> float:
    target = Target.from_nodes(context, nodes.omega, nodes.weight, nodes.value)
    residuals, jacobian = ProposalProblem(proposal, [target], Excess()).linearise(y)
    u, s, _ = torch.linalg.svd(jacobian, full_matrices=False)
    u = u[:, s > 1e-10 * s.max()]
    return float(torch.linalg.vector_norm(u.T @ residuals) / torch.linalg.vector_norm(residuals))


def nodes_of_family(
    integrand: Integrand, family: Callable[[Tensor, Tensor], Tensor], context: Context, rtol: float = 1e-2
) -> Nodes:
    """Nodes of the integrand's cells, with the values of the family at t = 0."""
    found = quadrature_nodes(integrand, context, rtol, count=3)
    with torch.no_grad():
        return Nodes(found.omega, found.weight, family(found.omega, torch.zeros((), dtype=torch.float64)))
