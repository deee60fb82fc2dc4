"""The interface that PBRT asks of a material: f, sample_f and pdf on unit vectors of the shading frame."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor

from dsfit.arguments import check_uniforms
from dsfit.bsdf.dual_scattering import DualScattering
from dsfit.context import Context
from dsfit.errors import FLOATS, InputError
from dsfit.frame import to_angles, to_vector
from dsfit.proposals.base import Proposal
from dsfit.scene.integrand import Integrand
from dsfit.scene.scattering import Scattering


class Sample(NamedTuple):
    """A sampled direction: BSDF value `[..., C]`, unit vector wi `[..., 3]`, density per steradian `[...]`."""

    f: Tensor
    wi: Tensor
    pdf: Tensor


class Material:
    """A BSDF with a proposal, as PBRT's integrators see one.

    Vectors are unit vectors `[..., 3]` in (tangent, normal, binormal), pointing away from the fibre. PBRT multiplies
    what `f` returns by |n . wi|, with n the normal of the shading frame, while a fibre's integrand is F cos(theta_i):
    so `f = F cos(theta_i) / |n . wi|` (chapter section 0.1). The quotient is unbounded where wi is perpendicular to n;
    the product with
    |n . wi| is what matters, and `f_cos` returns it without the detour.

    Args:
        bsdf: the dual scattering BSDF.
        proposal: what directions are drawn from; any proposal, heuristic or fitted.
        n, v: scattering fibres and directly lit share that the proposal is told, and, without `scattering`, the BSDF
            too.
        scattering: n and v towards each direction.

    Example:
        >>> import math
        >>> import torch
        >>> import dsfit
        >>> from dsfit.proposals import UniformSphere
        >>> material = dsfit.Material(dsfit.DualScattering(dsfit.Fiber.preset("blond")), UniformSphere())
        >>> wo = torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)
        >>> drawn = material.sample_f(wo, torch.tensor([0.3, 0.6], dtype=torch.float64))
        >>> math.isclose(float(drawn.pdf), 1 / (4 * math.pi))
        True
        >>> bool(torch.allclose(drawn.f, material.f(wo, drawn.wi)))
        True
    """

    def __init__(
        self,
        bsdf: DualScattering,
        proposal: Proposal,
        n: Any = 0.0,
        v: Any = None,
        scattering: Scattering | None = None,
    ) -> None:
        if not isinstance(proposal, Proposal):
            raise InputError("proposal", type(proposal).__name__, "a dsfit Proposal")
        self.bsdf, self.proposal, self.n, self.v = bsdf, proposal, n, v
        self._integrand = Integrand(bsdf, scattering=scattering)

    def context(self, wo: Tensor) -> Context:
        """The shading context of viewing directions `[*batch, 3]`."""
        omega = to_angles(_unit("wo", wo))
        return Context(omega[..., 0], omega[..., 1], self.n, self.v)

    def f_cos(self, wo: Tensor, wi: Tensor) -> Tensor:
        """F cos(theta_i), `[..., C]`: the integrand's factor for d omega_i."""
        return self._integrand(to_angles(_unit("wi", wi)), self.context(wo))

    def f(self, wo: Tensor, wi: Tensor) -> Tensor:
        """F cos(theta_i) / |n . wi|, `[..., C]`; to be multiplied by |n . wi|."""
        return self.f_cos(wo, wi) / _cos_normal(wi).unsqueeze(-1)

    def pdf(self, wo: Tensor, wi: Tensor) -> Tensor:
        """Density of `sample_f` at wi, per steradian."""
        return torch.exp(self.proposal(self.context(wo)).log_prob(to_angles(_unit("wi", wi))))

    def sample_f(self, wo: Tensor, u: Tensor) -> Sample:
        """Draw wi from uniforms `[*samples, *batch, k]` in (0, 1), k = `proposal(context).dimension`."""
        context = self.context(wo)
        distribution = self.proposal(context)
        check_uniforms(u, distribution.dimension, context.batch_shape)
        omega, log_prob = distribution.sample_with_log_prob(u)
        wi = to_vector(omega)
        value = self._integrand(omega, context) / _cos_normal(wi).unsqueeze(-1)
        return Sample(value, wi, torch.exp(log_prob))


def _cos_normal(wi: Tensor) -> Tensor:
    return wi[..., 1].abs().clamp_min(torch.finfo(wi.dtype).tiny ** 0.5)


def _unit(field: str, vector: Tensor) -> Tensor:
    if not isinstance(vector, Tensor) or vector.dtype not in FLOATS:
        raise InputError(field, getattr(vector, "dtype", vector), "a float64 or float32 tensor")
    if vector.ndim == 0 or vector.shape[-1] != 3:
        raise InputError(field, tuple(vector.shape), "unit vectors with a last dimension of 3")
    length = torch.linalg.vector_norm(vector.detach(), dim=-1)
    if not bool(((length - 1).abs() < 1e-3).all()):
        raise InputError(field, float(length.flatten()[(length - 1).abs().argmax()]), "unit vectors (length 1)")
    return vector
