"""Kernels that several tests share, contexts and directions to try them at."""

from __future__ import annotations

import copy
import functools

import torch
from torch import Tensor

import dsfit
from dsfit.context import Context
from dsfit.kernels import HairKernel
from dsfit.kernels.native import NoCompiler, library
from dsfit.proposals import AmortisedProposal
from dsfit.streams import ContextStream


@functools.cache
def bsdf(preset: str = "blond") -> dsfit.DualScattering:
    return dsfit.DualScattering(dsfit.Fiber.preset(preset), precision="table")


@functools.cache
def mixture(preset: str = "blond") -> AmortisedProposal:
    """With a network that is not zero, so that modes and widths leave their start."""
    proposal = AmortisedProposal(bsdf(preset), (8,))
    generator = torch.Generator().manual_seed(5)
    with torch.no_grad():
        last = proposal.network.weights[-1]
        last.copy_(0.3 * torch.randn(last.shape, generator=generator, dtype=last.dtype))
    return proposal.requires_grad_(False)


@functools.cache
def kernel(preset: str = "blond", mode: str = "eager") -> HairKernel:
    if mode == "eager":
        return HairKernel(bsdf(preset), mixture(preset), mode="eager")
    twin = copy.copy(kernel(preset))  # the same tables
    twin.backend, twin._programs = "compiled", {}
    return twin


@functools.cache
def has_compiler() -> bool:
    try:
        library(kernel().program("both").layout)
    except NoCompiler:
        return False
    return True


def contexts(count: int, seed: int = 1, v: float | None = None) -> Context:
    """float32 contexts of every kind; all with the same v if given."""
    context = ContextStream(theta="angle", rule="mixed").draw(count, torch.Generator().manual_seed(seed))
    context = context.to(torch.float32)
    return context if v is None else Context(context.theta_r, 0.0, context.n, torch.full_like(context.n, v))


def uniforms(*shape: int, seed: int = 2) -> Tensor:
    return torch.rand(*shape, 3, generator=torch.Generator().manual_seed(seed))


def directions(*shape: int, seed: int = 3) -> tuple[Tensor, Tensor]:
    """Uniform over the sphere."""
    u = torch.rand(2, *shape, generator=torch.Generator().manual_seed(seed))
    return torch.asin(2 * u[0] - 1), torch.pi * (2 * u[1] - 1)


def exact(context: Context, theta_i: Tensor, phi: Tensor, preset: str = "blond") -> Tensor:
    """F cos(theta_i) in float64 at the same float32 angles."""
    c = context.to(torch.float64)
    return bsdf(preset)(theta_i.double(), c.theta_r, phi.double(), c.n, c.v)


def exact_log_prob(context: Context, theta_i: Tensor, phi: Tensor, preset: str = "blond") -> Tensor:
    omega = torch.stack([theta_i, -phi], dim=-1).double()
    return mixture(preset)(context.to(torch.float64)).log_prob(omega)
