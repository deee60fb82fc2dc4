"""What every single sample must satisfy, and the PBRT-style interface of a material on unit vectors."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Protocol

import torch
from torch import Tensor

from dsfit.checks.furnace.draws import Draws
from dsfit.context import Context
from dsfit.frame import cos_inclination, to_vector


@dataclass(frozen=True)
class SampleWeights:
    """Facts about the weights f / p of single samples.

    Attributes:
        bad_values: integrand values that are negative or not finite.
        bad_weights: weights f / p of the proposal's own directions that are negative or not finite.
        zero_density: own directions at which `log_prob` is -inf or NaN, `returned` is, or p is +inf.
        largest: largest weight in units of the mean, over own directions; 0 without any.
        log_gap: largest |log p returned - log p evaluated| over own directions, beyond what a rounding of theta_i by
            4 ulp makes of it.
        invalid: samples that were no directions.
    """

    bad_values: int
    bad_weights: int
    zero_density: int
    largest: float
    log_gap: float
    invalid: int

    @property
    def faults(self) -> int:
        """Number of samples with a fault of the sampler's: bad values of the integrand are not."""
        return self.bad_weights + self.zero_density + self.invalid


def sample_weights(draws: Draws) -> SampleWeights:
    """Check each sample of the proposal by itself.

    A density that is only evaluated where it is sampled never shows that sampler and `log_prob` disagree: so the
    density returned with a direction is compared with that of the direction.
    """
    own = draws.own
    value, returned, evaluated = draws.value[own], draws.log_returned[own], draws.log_evaluated[own]
    bad = ~(value.isfinite() & (value >= 0)).all(-1)
    empty = ~(returned.isfinite() & evaluated.isfinite())
    weight = torch.linalg.vector_norm(value, dim=-1) * torch.exp(-returned)
    worse = ~(weight.isfinite() & (weight >= 0)) & ~bad & ~empty
    good = ~(bad | empty | worse)
    # p has a factor 1 / cos(theta_i): a rounding of theta_i shows as tan(theta_i) times that
    theta = draws.omega[own, 0]
    rounding = 4 * torch.finfo(theta.dtype).eps * math.pi / cos_inclination(theta)
    gap = ((returned - evaluated).abs() - rounding).clamp_min(0.0)[~empty]
    mean = weight[good].mean() if bool(good.any()) else torch.tensor(0.0)
    largest = float(weight[good].max() / mean) if float(mean) > 0 else 0.0
    return SampleWeights(
        bad_values=int(bad.sum()),
        bad_weights=int(worse.sum()),
        zero_density=int(empty.sum()),
        largest=largest,
        log_gap=float(gap.max()) if len(gap) else 0.0,
        invalid=draws.invalid,
    )


class MaterialLike(Protocol):
    """What PBRT asks of a material, on unit vectors `[..., 3]` in (tangent, normal, binormal)."""

    def f(self, wo: Tensor, wi: Tensor) -> Tensor:
        """BSDF value `[..., C]`, to be multiplied by |n . wi|."""

    def sample_f(self, wo: Tensor, u: Tensor) -> Any:
        """Fields `f`, `wi`, `pdf`."""

    def pdf(self, wo: Tensor, wi: Tensor) -> Tensor:
        """Density of `sample_f` per steradian `[...]`."""


@dataclass(frozen=True)
class MaterialConsistency:
    """How a material agrees with the integrand and with itself; largest relative deviations.

    Attributes:
        convention: of `f |n . wi|` from F cos(theta_i), over given directions.
        sampled_f, sampled_pdf: of `sample_f`'s f and pdf from `f` and `pdf` at the returned wi.
        length: of | |wi| - 1 |.
        estimate, standard_error: PBRT's mean of `f |n . wi| / pdf`, `[C]`.
        z: (estimate - expected) / standard_error, `[C]`, where an expected value was given.
    """

    convention: float
    sampled_f: float
    sampled_pdf: float
    length: float
    estimate: Tensor
    standard_error: Tensor
    z: Tensor | None

    @property
    def deviation(self) -> float:
        """The largest of the deviations."""
        return max(self.convention, self.sampled_f, self.sampled_pdf, self.length)


def material_consistency(
    material: MaterialLike,
    integrand: Any,
    context: Context,
    u: Tensor,
    omega: Tensor,
    expected: Tensor | None = None,
) -> MaterialConsistency:
    """Compare a material with the integrand that it stands for.

    PBRT multiplies f by |n . wi|, with n the normal of the shading frame, where a fibre's integrand has
    F cos(theta_i): a material that returns F, or F cos(theta_i), is wrong by one of the two cosines.

    Args:
        material: the material.
        integrand: `integrand(omega_i, context)`, F cos(theta_i) under radiance 1.
        context: a single context.
        u: uniforms `[N, k]`.
        omega: directions `[M, 2]` at which f and pdf are evaluated.
        expected: int F cos(theta_i) domega_i, `[C]`.
    """
    with torch.no_grad():
        wo = to_vector(torch.stack([context.theta_r, context.phi_r]))
        wi = to_vector(omega)
        made = material.f(wo, wi) * wi[:, 1:2].abs()
        convention = _relative(made, integrand(omega, context))
        drawn = material.sample_f(wo, u)
        weight = drawn.f * drawn.wi[:, 1:2].abs() / drawn.pdf[:, None]
        mean, error = weight.mean(0), weight.std(0) / math.sqrt(len(weight))
        return MaterialConsistency(
            convention=convention,
            sampled_f=_relative(drawn.f * drawn.wi[:, 1:2].abs(), material.f(wo, drawn.wi) * drawn.wi[:, 1:2].abs()),
            sampled_pdf=_relative(drawn.pdf, material.pdf(wo, drawn.wi)),
            length=float((torch.linalg.vector_norm(drawn.wi, dim=-1) - 1).abs().max()),
            estimate=mean,
            standard_error=error,
            z=None if expected is None else (mean - expected) / error,
        )


def _relative(a: Tensor, b: Tensor) -> float:
    """Largest difference, relative to the values, or to 1e-6 of their largest where they are below that."""
    if not bool(a.isfinite().all() and b.isfinite().all()):
        return math.inf
    scale = torch.maximum(a.abs(), b.abs())
    return float(((a - b).abs() / scale.clamp_min(1e-6 * float(scale.max()) + 1e-300)).max())
