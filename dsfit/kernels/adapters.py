"""Kernels behind the interfaces of integrands and proposals, so that estimators and races can run on them."""

from __future__ import annotations

import copy
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from dsfit.arguments import check_directions, check_uniforms
from dsfit.context import Context
from dsfit.frame import wrap
from dsfit.kernels.contexts import Contexts
from dsfit.proposals.base import Distribution, Proposal
from dsfit.scene.integrand import Integrand
from dsfit.scene.lights import Light

if TYPE_CHECKING:
    from dsfit.kernels.hair import HairKernel


class KernelIntegrand(Integrand):
    """F cos(theta_i) L by a kernel, `[..., C]` in the dtype of the directions; computed in float32, without gradients.

    Args:
        kernel: evaluates the BSDF.
        light: incident radiance; left out, a furnace of radiance 1. Scattering hints are the context's.
    """

    def __init__(self, kernel: HairKernel, light: Light | None = None) -> None:
        super().__init__(kernel.bsdf, light)
        self.kernel = kernel

    def __call__(self, omega_i: Tensor, context: Context) -> Tensor:
        check_directions(omega_i, context.batch_shape, "omega_i")
        shape = torch.broadcast_shapes(omega_i.shape[:-1], context.batch_shape)
        theta_i, phi = _relative(omega_i, context, shape)
        contexts = self.kernel.bare_contexts(context.reshape(-1))
        value = self.kernel.eval(contexts, theta_i, phi).reshape(*shape, -1).to(omega_i.dtype)
        return value * self.light(omega_i)


class KernelDistribution(Distribution):
    """The mixture of prepared contexts."""

    dimension = 3

    def __init__(self, kernel: HairKernel, context: Context) -> None:
        self.kernel, self.context, self.batch_shape = kernel, context, context.batch_shape
        self.contexts: Contexts = kernel.prepare_context(context.reshape(-1))

    def taken(self, index: Tensor) -> KernelDistribution:
        """The mixtures of some of the contexts, as they are now."""
        other = copy.copy(self)
        other.context, other.contexts = self.context.reshape(-1)[index], self.contexts[index]
        other.batch_shape = other.context.batch_shape
        return other

    def sample_with_log_prob(self, u: Tensor) -> tuple[Tensor, Tensor]:
        omega = self.sample(u)
        return omega, self.log_prob(omega)

    def sample(self, u: Tensor) -> Tensor:
        u = check_uniforms(u, self.dimension, self.batch_shape)
        flat = u[..., :3].to(torch.float32).reshape(-1, len(self.contexts), 3)
        theta_i, phi = (x.reshape(u.shape[:-1]).to(u.dtype) for x in self.kernel.sample(self.contexts, flat))
        return torch.stack([theta_i, wrap(self.context.phi_r - phi)], dim=-1)

    def log_prob(self, omega: Tensor) -> Tensor:
        check_directions(omega, self.batch_shape)
        shape = torch.broadcast_shapes(omega.shape[:-1], self.batch_shape)
        theta_i, phi = _relative(omega, self.context, shape)
        return self.kernel.log_prob(self.contexts, theta_i, phi).reshape(shape).to(omega.dtype)


class KernelProposal(Proposal):
    """The kernel's mixture as a proposal; computed in float32, without gradients."""

    def __init__(self, kernel: HairKernel) -> None:
        super().__init__()
        self.kernel = kernel

    def forward(self, context: Context) -> KernelDistribution:
        return KernelDistribution(self.kernel, context)


def _relative(omega: Tensor, context: Context, shape: torch.Size) -> tuple[Tensor, Tensor]:
    """theta_i and phi_r - phi_i as float32 `[S, B]`."""
    phi = (context.phi_r - omega[..., 1]).expand(shape)
    pair = omega[..., 0].expand(shape), phi
    count = context.batch_shape.numel()
    return tuple(x.to(torch.float32).reshape(-1, count).contiguous() for x in pair)  # type: ignore[return-value]
