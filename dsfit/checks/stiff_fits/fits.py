"""Fits that start badly, have redundant or ineffective parameters, or integrands at the edge of what a fibre can be.

Two families. Mixtures of Gaussian lobes over the inclination with uniform azimuth, fitted to a density of the same
family, so that the least excess is known to be 0. And the structured family on the dual scattering BSDF of extreme
fibres, where nobody knows the optimum.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor, nn

from dsfit.bsdf import DualScattering, Fiber
from dsfit.checks.stiff_fits.cases import (
    Case,
    Limits,
    Solved,
    fit_case,
    options_of,
    refused_case,
    theta_panels,
)
from dsfit.context import Context
from dsfit.cubature import integrate
from dsfit.fit.fit import fit
from dsfit.frame import cos_inclination, wrap
from dsfit.proposals import GaussianLobe, Mixture, Product, StructuredProposal, UniformAzimuth
from dsfit.proposals.base import Proposal
from dsfit.quadrature import panel_points
from dsfit.quality import Nodes, quadrature_nodes
from dsfit.scene import Integrand

DEG = math.pi / 180
OBJECTIVES = ("excess", "log_excess", "forward_kl", "variance_cost")
DEFENSIVE = 0.02
"""Share of the uniform sphere in the Gaussian family, in the target too."""

Lobe = tuple[float, float, float]
"""Weight, centre and width (radians of theta_h) of a lobe."""


class WithIdleParameter(Proposal):
    """A proposal and a parameter that has no effect on it."""

    def __init__(self, proposal: Proposal) -> None:
        super().__init__()
        self.proposal = proposal
        self.idle = nn.Parameter(torch.tensor(0.5, dtype=torch.float64))

    def forward(self, context: Context) -> Any:
        return self.proposal(context)

    @property
    def components(self) -> Any:
        """Those of the proposal."""
        return self.proposal.components


def gaussians(lobes: Sequence[Lobe], defensive: float = DEFENSIVE) -> Mixture:
    """The mixture of these lobes, uniform in azimuth."""
    parts = [Product(GaussianLobe(centre, width), UniformAzimuth()) for _, centre, width in lobes]
    return Mixture(parts, [weight for weight, _, _ in lobes], defensive)


def one_context(theta_deg: float = 20.0, n: float = 0.0) -> Context:
    """A single context, float64."""
    return Context(torch.tensor(theta_deg * DEG, dtype=torch.float64), 0.0, n, None)


@torch.no_grad()
def nodes_of(density: Proposal, context: Context, scale: float = 1.0) -> Nodes:
    """Nodes that integrate a density of the Gaussian family exactly: Gauss panels between quantiles of its lobes, and
    4 azimuths."""
    theta, weight = panel_points(theta_panels(density, context), 4)
    theta, weight = theta.reshape(-1), weight.reshape(-1)
    phi = math.pi * (torch.arange(4, dtype=torch.float64) - 1.5) / 2
    omega = torch.stack(torch.meshgrid(theta, phi, indexing="ij"), -1).reshape(-1, 2)
    weight = (weight * cos_inclination(theta) * math.pi / 2)[:, None].expand(-1, 4).reshape(-1)
    return Nodes(omega, weight, scale * density(context).log_prob(omega).exp()[:, None])


def mass(proposal: nn.Module, context: Context, edges: Callable[[Tensor], Tensor] | None = None) -> float:
    """`int p domega` by adaptive cubature between quantiles of the components' inclinations and the azimuths of
    `edges(theta)`, of which there are five if left out."""
    law = proposal(context)

    def density(theta: Tensor, phi: Tensor) -> Tensor:
        omega = torch.stack([theta, wrap(context.phi_r - phi)], -1)
        return (law.log_prob(omega).exp() * cos_inclination(theta))[..., None]

    def quarters(theta: Tensor) -> Tensor:
        return torch.linspace(-math.pi, math.pi, 5, dtype=torch.float64).expand(*theta.shape, 5)

    panels = theta_panels(proposal, context)
    return float(integrate(density, panels, edges or quarters, 1e-5, 600_000).value[0])


TARGET_ONE: list[Lobe] = [(1.0, 0.2, 0.15)]
TARGET_TWO: list[Lobe] = [(0.6, 0.1, 0.02), (0.4, 0.5, 0.2)]

STARTS: dict[str, tuple[list[Lobe], list[Lobe]]] = {
    "width_1e-4": ([(1.0, 0.18, 1e-4)], TARGET_ONE),
    "width_10": ([(1.0, 0.18, 10.0)], TARGET_ONE),
    "centre_far": ([(1.0, -1.5, 0.1)], TARGET_ONE),
    "weight_1e-12": ([(1.0, 0.3, 0.3), (1e-12, 0.1, 0.05)], TARGET_TWO),
    "weight_zero": ([(1.0, 0.3, 0.3), (1e-320, 0.1, 0.05)], TARGET_TWO),
    "twin_lobes": ([(0.5, 0.3, 0.3), (0.5, 0.3, 0.3)], TARGET_ONE),
}
"""Name to lobes at the start and lobes of the target."""
ALL_OBJECTIVES = ("width_10", "weight_1e-12", "twin_lobes")
"""Those that all objectives are tried on; the others are tried on the excess and its logarithm."""


def gaussian_cases(
    start: Callable[[], Proposal],
    target: Sequence[Lobe],
    name: str,
    scale: float = 1.0,
    objectives: Sequence[str] = OBJECTIVES,
) -> list[Case]:
    """Fits of the Gaussian family to a density of the same family; the least value of every objective is 0."""
    context = one_context()
    nodes = nodes_of(gaussians(target), context, scale)
    size = functools.partial(mass, context=context)
    count = len(start().components)
    return [fit_case(name, one, start(), None, context, nodes, size, 0.0, count) for one in objectives]


def idle_parameter() -> list[Case]:
    """A parameter without effect on the density."""
    return gaussian_cases(
        lambda: WithIdleParameter(gaussians([(1.0, 0.0, 0.5)])), TARGET_ONE, "idle_parameter", objectives=OBJECTIVES[:2]
    )


def tiny_integrand() -> list[Case]:
    """An integrand of size 1e-290: nothing may depend on its scale."""
    return gaussian_cases(lambda: gaussians([(1.0, 0.0, 0.5)]), TARGET_ONE, "tiny_integrand", 1e-290, OBJECTIVES[:2])


def misses_support() -> list[Case]:
    """A lobe of 1e-3 rad without a defensive share: at most nodes its density underflows, and the objective there is
    infinite to float64."""
    context = one_context()
    nodes = nodes_of(gaussians(TARGET_ONE), context)
    size = functools.partial(mass, context=context)
    start = [(1.0, 0.5, 1e-3)]
    return [
        fit_case("misses_support", objective, gaussians(start, 0.0), None, context, nodes, size, components=1)
        for objective in ("excess", "forward_kl")
    ]


def _structured(name: str, fiber: Fiber, context: Context) -> list[Case]:
    bsdf = DualScattering(fiber, precision="table")
    integrand = Integrand(bsdf)
    nodes = quadrature_nodes(integrand, context, rtol=1e-2, even=True)
    start = StructuredProposal(bsdf, context)
    size = functools.partial(mass, context=context, edges=lambda theta: integrand.azimuth_edges(context, theta))
    cases = []
    for objective, solvers in (("excess", None), ("log_excess", ("torch.lbfgs",)), ("forward_kl", ("optimistix.lm",))):
        case = fit_case(name, objective, start, integrand, context, nodes, size)
        case.solvers = solvers
        cases.append(case)
    return cases


def narrow_beside_wide() -> list[Case]:
    """Lobes of 0.01, 7.5 and 60 degrees in one fibre."""
    beta = torch.tensor([0.01, 7.5, 60.0], dtype=torch.float64) * DEG
    return _structured("narrow_beside_wide", Fiber.preset("blond", beta=beta), one_context(30.0))


def black_behind_20() -> list[Case]:
    """Black hair behind 20 fibres."""
    return _structured("black_behind_20", Fiber.preset("black"), one_context(0.0, 20.0))


def grazing() -> list[Case]:
    """A view along the fibre, theta_r = 89.9 degrees."""
    return _structured("grazing", Fiber.preset("brown"), one_context(89.9, 3.0))


def opaque() -> list[Case]:
    """sigma_a = 1e4 behind 5 fibres: the integrand is all but zero."""
    return _structured("opaque", Fiber.preset("black", sigma_a=[1e4]), one_context(0.0, 5.0))


def zero_integrand() -> list[Case]:
    """No light at all: d_f = 0, d_b = 0 and v = 0. There is no best density, so the fit has to refuse."""
    bsdf = DualScattering(Fiber.preset("blond"), 0.0, 0.0, azimuthal="simplified")
    integrand, context = Integrand(bsdf), one_context(20.0, 3.0)

    def solve(solver: str, limits: Limits) -> Solved:
        found = fit(gaussians(TARGET_ONE), integrand, context, "excess", solver, **options_of(solver, limits))
        return Solved(found.result, found.proposal, found.excess)

    return [refused_case("zero_integrand", "nodes.value", solve)]


FITS: dict[str, Callable[[], list[Case]]] = {
    **{
        name: functools.partial(
            lambda name, start, target: gaussian_cases(
                lambda: gaussians(start),
                target,
                name,
                objectives=OBJECTIVES if name in ALL_OBJECTIVES else OBJECTIVES[:2],
            ),
            name,
            start,
            target,
        )
        for name, (start, target) in STARTS.items()
    },
    "idle_parameter": idle_parameter,
    "tiny_integrand": tiny_integrand,
    "misses_support": misses_support,
    "zero_integrand": zero_integrand,
    "narrow_beside_wide": narrow_beside_wide,
    "black_behind_20": black_behind_20,
    "grazing": grazing,
    "opaque": opaque,
}
"""Fits by name, each as a function that makes its cases, one per objective."""
