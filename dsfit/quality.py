"""How good a density can be, and how good a given one is, by deterministic quadrature with an error bound.

For f = integrand(omega) with channels, `|f|` its Euclidean norm, the second moment of any density p per steradian is
`M(p) = int |f|^2/p domega >= M* = (int |f| domega)^2`; `excess(p) = M(p)/M* - 1 = int (p* - p)^2/p domega` with p* =
|f|/int |f|.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from dsfit.context import Context
from dsfit.cubature import Cubature, integrate, nodes_of
from dsfit.errors import InputError, as_number
from dsfit.frame import cos_inclination, wrap
from dsfit.proposals.base import Distribution, Proposal
from dsfit.scene.integrand import Integrand

_NODE_COUNT = 5


@dataclass(frozen=True)
class Reference:
    """Integral of a batch of contexts, with error bounds.

    Attributes:
        value, error: int f domega and its bound, `[*batch, C]`.
        norm, norm_error: int |f| domega and its bound, `[*batch]`.
        m_star: least second moment any density can have, norm^2, `[*batch]`.
        evaluations: integrand evaluations over all contexts.
        converged: whether every context met the tolerance.
    """

    value: Tensor
    error: Tensor
    norm: Tensor
    norm_error: Tensor
    m_star: Tensor
    evaluations: int
    converged: bool


@dataclass(frozen=True)
class Nodes:
    """Quadrature nodes of one context: omega `[Q, 2]`, solid-angle weights `[Q]` (sum w f ~ int f domega), values
    `[Q, C]`.

    Example:
        >>> import torch
        >>> import dsfit
        >>> cosine = dsfit.FunctionIntegrand(lambda omega, context: torch.cos(omega[..., :1]))
        >>> nodes = dsfit.quadrature_nodes(cosine, dsfit.Context(0.0))
        >>> round(float(nodes.weight.sum()), 6)  # 4 pi
        12.566371
    """

    omega: Tensor
    weight: Tensor
    value: Tensor

    @property
    def norm(self) -> Tensor:
        """|f| at the nodes, `[Q]`."""
        return torch.linalg.vector_norm(self.value, dim=-1)


@dataclass(frozen=True)
class Excess:
    """Excess of a density over the least second moment, for a batch of contexts, each `[*batch]`.

    Attributes:
        value, error: M(p)/M* - 1 and the quadrature's error bound.
        largest_weight: sup |f|/p over the nodes, in units of the mean int |f|.
        mass: int p domega over the nodes' quadrature, a check of normalisation (1 for a proper density).
        converged: whether every context met the tolerance.
    """

    value: Tensor
    error: Tensor
    largest_weight: Tensor
    mass: Tensor
    converged: bool


def _domain(
    integrand: Integrand, context: Context, even: bool, coarse: bool = False
) -> tuple[Tensor, Callable[[Tensor], Tensor]]:
    def edges(theta: Tensor) -> Tensor:
        found = integrand.azimuth_edges(context, theta, coarse=coarse)
        return found.clamp_min(0.0)[..., found.shape[-1] // 2 :] if even else found

    return integrand.theta_breaks(context), edges


def _cubature(
    integrand: Integrand,
    context: Context,
    columns: Callable[[Tensor, Tensor], Tensor],
    rtol: float,
    max_evaluations: int,
    even: bool,
    coarse: bool = False,
) -> Cubature:
    """Integrate `columns(omega, f) -> [..., K]` over the sphere; half of it, doubled, if everything is even in
    azimuth.
    """
    breaks, edges = _domain(integrand, context, even, coarse)
    factor = 2.0 if even else 1.0

    def function(theta: Tensor, phi: Tensor) -> Tensor:
        omega = torch.stack([theta, wrap(context.phi_r - phi)], dim=-1)
        flat = omega.reshape(-1, 2)
        value = columns(flat, integrand(flat, context))
        return factor * (value * cos_inclination(flat[:, 0])[:, None]).reshape(*theta.shape, -1)

    return integrate(function, breaks, edges, rtol, max_evaluations)


def reference(
    integrand: Integrand, context: Context, rtol: float = 1e-8, *, max_evaluations: int = 20_000_000
) -> Reference:
    """int f domega, its norm and M*, by adaptive cubature that follows the lobes, edges and lights.

    The bound sums |Gauss 10 - Gauss 7| over cells. `converged` is False where `max_evaluations` per context did not
    suffice; the error bound then says what was reached. Float64 throughout.

    Raises:
        InputError: `rtol` is not in (0, 1), no context, or an integrand that is none.

    Example:
        >>> import dsfit
        >>> furnace = dsfit.Integrand(dsfit.DualScattering(dsfit.Fiber.preset("nonabsorbing")))
        >>> found = dsfit.reference(furnace, dsfit.Context(0.0, n=0.0), rtol=1e-5)
        >>> [round(x, 3) for x in found.value.tolist()], bool(found.converged)
        ([1.468, 1.468, 1.468], True)
    """
    _check(integrand, context, rtol, max_evaluations)
    context = context.to(torch.float64)
    results = []
    for one in _each(context):
        results.append(
            _cubature(
                integrand,
                one,
                lambda _, f: torch.cat([f, torch.linalg.vector_norm(f, dim=-1, keepdim=True)], dim=-1),
                rtol,
                max_evaluations,
                integrand.is_even,
            )
        )
    shape = context.batch_shape
    value = torch.stack([r.value for r in results]).reshape(*shape, -1)
    error = torch.stack([r.error for r in results]).reshape(*shape, -1)
    return Reference(
        value=value[..., :-1],
        error=error[..., :-1],
        norm=value[..., -1],
        norm_error=error[..., -1],
        m_star=value[..., -1] ** 2,
        evaluations=sum(r.evaluations for r in results),
        converged=all(r.converged for r in results),
    )


def quadrature_nodes(
    integrand: Integrand, context: Context, rtol: float = 1e-3, *, even: bool = False, count: int = _NODE_COUNT
) -> Nodes:
    """Nodes for fits: the cells that integrate |f| to `rtol`, each with a tensor Gauss rule of `count` x `count`
    points.

    `rtol` holds for `count = 10`, the rule that the cells were refined by; the default is sparser (some 1e-4 for smooth
    integrands), because a fit evaluates every node at every step and judges its result by `excess` afterwards.

    Args:
        context: a single context (batch shape `()`).
        even: keep only phi >= 0, with doubled weights. Only for integrands and densities even in azimuth.

    Example:
        >>> import torch
        >>> import dsfit
        >>> cosine = dsfit.FunctionIntegrand(lambda omega, context: torch.cos(omega[..., :1]))
        >>> nodes = dsfit.quadrature_nodes(cosine, dsfit.Context(0.0), rtol=1e-5)
        >>> round(float((nodes.weight * nodes.norm).sum()), 6)
        9.869605
    """
    _check(integrand, context, rtol)
    context = context.to(torch.float64)
    if context.batch_shape != ():
        raise InputError("context", tuple(context.batch_shape), "a single context, of batch shape ()")
    symmetric = integrand.is_even
    found = _cubature(
        integrand,
        context,
        lambda _, f: torch.linalg.vector_norm(f, dim=-1, keepdim=True),
        rtol,
        2_000_000,
        symmetric,
        coarse=True,
    )
    with torch.no_grad():
        theta, phi, weight = nodes_of(found.cells, _domain(integrand, context, symmetric, coarse=True)[1], count)
        keep = (weight > 0).flatten()
        theta, phi = theta.flatten()[keep], phi.flatten()[keep]
        weight = weight.flatten()[keep] * cos_inclination(theta)
        value = integrand(torch.stack([theta, wrap(context.phi_r - phi)], dim=-1), context)
        if symmetric and even:
            weight = 2 * weight
        elif symmetric:
            theta, phi, weight, value = theta.repeat(2), torch.cat([phi, -phi]), weight.repeat(2), value.repeat(2, 1)
        omega = torch.stack([theta, wrap(context.phi_r - phi)], dim=-1)
    return Nodes(omega, weight, value)


def excess(
    integrand: Integrand,
    proposal: Proposal,
    context: Context,
    rtol: float = 1e-3,
    *,
    max_evaluations: int = 5_000_000,
) -> Excess:
    """Excess of a proposal's density, `int (p* - p)^2/p domega`: no cancellation however close p is to p*.

    `rtol` is relative to the excess (with an absolute floor of 1e-7).

    Example:
        >>> import torch
        >>> import dsfit
        >>> from dsfit.proposals import UniformSphere
        >>> cosine = dsfit.FunctionIntegrand(lambda omega, context: torch.cos(omega[..., :1]))
        >>> round(float(dsfit.excess(cosine, UniformSphere(), dsfit.Context(0.0)).value), 5)  # 32 / (3 pi^2) - 1
        0.08076
    """
    _check(integrand, context, rtol, max_evaluations)
    if not callable(proposal):
        raise InputError("proposal", type(proposal).__name__, "a proposal")
    context = context.to(torch.float64)
    rows = [_excess_one(integrand, proposal, one, rtol, max_evaluations) for one in _each(context)]
    shape = context.batch_shape
    columns = [torch.stack([row[k] for row in rows]).reshape(shape) for k in range(4)]
    return Excess(*columns, converged=all(row[4] for row in rows))


def _excess_one(
    integrand: Integrand, proposal: Proposal, context: Context, rtol: float, max_evaluations: int
) -> tuple[Tensor, Tensor, Tensor, Tensor, bool]:
    with torch.no_grad():
        norm = reference(integrand, context, 1e-6).norm
        distribution: Distribution = proposal(context)
        largest = torch.zeros((), dtype=torch.float64)

        def columns(omega: Tensor, f: Tensor) -> Tensor:
            nonlocal largest
            target = torch.linalg.vector_norm(f, dim=-1) / norm
            density = torch.exp(distribution.log_prob(omega))
            ratio = torch.where(target > 0, target / density, 0.0)
            largest = torch.maximum(largest, ratio.max())
            # p* and p are carried along with unit integrals: they set the scale against which 1e-7 is the floor
            gap = torch.where(target > 0, (ratio - 1) * (target - density), density)
            return torch.stack([gap + 1e-4 * target, density], dim=-1)

        found = _cubature(integrand, context, columns, min(rtol, 1e-3), max_evaluations, False)
        return found.value[0] - 1e-4, found.error[0], largest, found.value[1], found.converged


def _each(context: Context) -> list[Context]:
    flat = context.reshape(-1)
    return [flat[i] for i in range(len(flat))]


def _check(integrand: Integrand, context: Context, rtol: float, max_evaluations: int = 1) -> None:
    for name in ("theta_breaks", "azimuth_edges", "is_even"):
        if not hasattr(integrand, name):
            raise InputError("integrand", type(integrand).__name__, f"an Integrand (this has no {name})")
    if not isinstance(context, Context) or not context.batch_shape.numel():
        raise InputError("context", context, "a Context with at least one element")
    as_number("rtol", rtol, 0.0, 1.0, open_low=True, open_high=True)
    if isinstance(max_evaluations, bool) or not isinstance(max_evaluations, int) or max_evaluations < 1:
        raise InputError("max_evaluations", max_evaluations, "an integer >= 1")
