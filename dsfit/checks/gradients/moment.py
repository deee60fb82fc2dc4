"""The second moment of the weights and its gradient in a proposal's parameters, by quadrature.

With F the integrand, `|F|` its norm over channels and p the proposal's density per steradian,

    M = int |F|^2 / p domega,        dM/dx = -int |F|^2 / p dlog p/dx domega,

here both in units of the least second moment `M* = (int |F| domega)^2`, so that M - 1 is the excess.
"""

from __future__ import annotations

import copy
import time
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from dsfit.context import Context
from dsfit.cubature import integrate
from dsfit.errors import InputError
from dsfit.frame import cos_inclination, wrap
from dsfit.proposals.base import Proposal
from dsfit.proposals.mixture import Mixture
from dsfit.proposals.parameters import Bounded
from dsfit.quality import reference
from dsfit.scene.integrand import Integrand


def learnable(proposal: Proposal) -> Proposal:
    """A copy in which everything that can be learned is a parameter that requires grad, also what was made with
    `learnable=False`."""
    made = copy.deepcopy(proposal)
    for module in made.modules():
        for name in ("raw", "logits"):
            if isinstance(module, (Bounded, Mixture)) and name in module._buffers:
                value = module._buffers.pop(name)
                setattr(module, name, nn.Parameter(value))
                module.learnable = True
    return made.requires_grad_(True)


def defended(proposal: Proposal, share: float) -> Proposal:
    """The proposal itself if it is a mixture with a defensive share, else mixed with `share` of the uniform sphere.

    Without it |F|^2 / p^2 is unbounded where the tails of p are lighter than those of F, and no Monte Carlo estimate of
    the second moment has a standard error.
    """
    if isinstance(proposal, Mixture) and proposal.defensive > 0:
        return proposal
    return Mixture([proposal], defensive=share, learnable=False)


@dataclass(frozen=True)
class Layout:
    """Where each element of each learnable parameter is in a flat vector.

    Attributes:
        names: of the parameters, as in `named_parameters()`.
        shapes: of the parameters.
        labels: one for each element, as in `components.0.longitudinal.std.raw` or `logits[2]`.
    """

    names: tuple[str, ...]
    shapes: tuple[torch.Size, ...]
    labels: tuple[str, ...]

    @staticmethod
    def of(proposal: nn.Module) -> Layout:
        """Of the parameters that require grad."""
        named = [(name, p) for name, p in proposal.named_parameters() if p.requires_grad]
        labels = []
        for name, value in named:
            many = value.numel() > 1 or value.dim() > 0
            labels += [f"{name}[{k}]" if many else name for k in range(value.numel())]
        return Layout(tuple(n for n, _ in named), tuple(p.shape for _, p in named), tuple(labels))

    def flat(self, jacobian: dict[str, Tensor], rows: int) -> Tensor:
        """`[rows, P]` from the Jacobian by name."""
        return torch.cat([jacobian[name].reshape(rows, -1) for name in self.names], dim=-1)


@torch.no_grad()
def log_prob_and_slopes(proposal: Proposal, context: Context, omega: Tensor, layout: Layout) -> tuple[Tensor, Tensor]:
    """`log p` `[N]` and its derivative `[N, P]` in the parameters, at directions `[N, 2]`."""
    value, jacobian = proposal.log_prob_with_jacobian(context, omega)
    return value.detach(), layout.flat(jacobian, len(omega)).detach()


@dataclass(frozen=True)
class ExactMoment:
    """Second moment and gradient by quadrature, in units of M*.

    Attributes:
        moment: M / M*.
        gradient, error: `[P]`, with the quadrature's bound.
        labels: of the P parameters.
        norm: int |F| domega.
        evaluations: of integrand and proposal.
        converged: whether the tolerance was met.
        seconds: wall time.
    """

    moment: float
    gradient: Tensor
    error: Tensor
    labels: tuple[str, ...]
    norm: float
    evaluations: int
    converged: bool
    seconds: float

    @property
    def size(self) -> float:
        """Euclidean norm of the gradient."""
        return float(torch.linalg.vector_norm(self.gradient))


def moment_gradient(
    integrand: Integrand,
    proposal: Proposal,
    context: Context,
    rtol: float = 1e-3,
    *,
    norm: float | None = None,
    max_evaluations: int = 400_000,
) -> ExactMoment:
    """M / M* and its gradient by adaptive cubature over the integrand's own cells, refined for the gradient as well.

    Args:
        integrand: of one shading point.
        proposal: with parameters that require grad; its density must be positive where the integrand is.
        context: a single context.
        rtol: wanted error of M and of every component of the gradient, relative to M.
        norm: int |F| domega if known.
        max_evaluations: where to stop; `converged` and `error` say what was reached.

    Raises:
        InputError: the proposal has nothing to learn, or the context is a batch.
    """
    layout = Layout.of(proposal)
    if not layout.names:
        raise InputError("proposal", type(proposal).__name__, "a proposal with parameters that require grad")
    if context.batch_shape != ():
        raise InputError("context", tuple(context.batch_shape), "a single context, of batch shape ()")
    began = time.perf_counter()
    size = float(reference(integrand, context, 1e-5).norm) if norm is None else norm

    def function(theta: Tensor, phi: Tensor) -> Tensor:
        omega = torch.stack([theta, wrap(context.phi_r - phi)], dim=-1).reshape(-1, 2)
        square = (integrand(omega, context) / size).square().sum(-1)
        log_p, slopes = log_prob_and_slopes(proposal, context, omega, layout)
        density = torch.where(square > 0, square * torch.exp(-log_p), 0.0) * cos_inclination(omega[:, 0])
        # the gradient rides on M, so that the tolerance of every column is relative to M
        columns = density[:, None] * torch.cat([torch.ones_like(slopes[:, :1]), 1 - slopes], dim=-1)
        return columns.reshape(*theta.shape, -1)

    found = integrate(
        function,
        integrand.theta_breaks(context),
        lambda theta: integrand.azimuth_edges(context, theta, coarse=True),
        rtol,
        max_evaluations,
    )
    seconds = time.perf_counter() - began
    gradient, error = found.value[1:] - found.value[0], found.error[1:] + found.error[0]
    moment = float(found.value[0])
    return ExactMoment(moment, gradient, error, layout.labels, size, found.evaluations, found.converged, seconds)


def parts_of(labels: Sequence[str], most: int = 40) -> list[str]:
    """Short names of parameters for tables and plots: without the words that all of them share."""
    alone = not any("components.1." in x for x in labels)
    short = [x.replace("components.0.", "") if alone else x.replace("components.", "") for x in labels]
    short = [x.replace(".raw", "").replace("longitudinal.", "θ ") for x in short]
    short = [x.replace("azimuthal.", "φ ").replace("base.", "") for x in short]
    return [x[-most:] for x in short]
