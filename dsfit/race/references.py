"""What estimates of a race are compared with: integrals of many contexts at once, in a furnace."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from dsfit.bsdf import longitudinal
from dsfit.bsdf.azimuthal import support_edges
from dsfit.bsdf.breaks import _jumps, theta_breaks
from dsfit.bsdf.dual_scattering import DualScattering
from dsfit.context import Context
from dsfit.errors import InputError
from dsfit.frame import HALF_PI, cos_inclination, theta_diff, theta_half
from dsfit.quadrature import PiecewiseChebyshev, gauss_legendre, panel_points
from dsfit.scene import ConstantLight, ConstantScattering, Integrand

_AZIMUTHS = 48
_POINTS = 8
_AT_ONCE = 256


class StreamReference:
    """int f domega for batches of contexts of one round fibre under a constant light, to about 1e-5 in float64.

    With a constant light the azimuth enters by N_p and N^G_p alone, so their integrals over phi, functions of
    theta_diff, are made once (piecewise Chebyshev), and each context is one integral over theta_i on panels that follow
    the lobes. Some hundred times faster than `dsfit.reference`, and independent of it: `check` compares the two.

    Raises:
        InputError: another light or scattering, an eccentric fibre, or azimuths and a convention that do not factor.
    """

    def __init__(self, integrand: Integrand) -> None:
        self.check_scene(integrand)
        bsdf = integrand.bsdf
        self.integrand, self.bsdf = integrand, bsdf
        breaks = sorted({0.0, HALF_PI, *(float(x) for x in _jumps(bsdf))})
        with torch.no_grad():
            self._around = PiecewiseChebyshev(self._azimuths, torch.tensor(breaks, dtype=torch.float64), 1e-7)

    @staticmethod
    def check_scene(integrand: Integrand) -> None:
        """Refuse what the class does not integrate; see there."""
        bsdf = integrand.bsdf
        plain = isinstance(integrand.light, ConstantLight) and isinstance(integrand.scattering, ConstantScattering)
        if not plain:
            raise InputError("integrand", "another light or scattering", "a constant light and constant scattering")
        if not bsdf.fiber.is_round or bsdf.fiber.batch_shape:
            raise InputError("fiber", "an eccentric fibre or a batch", "a single round fibre")
        if bsdf.convention.share == "sum" or bsdf.convention.back_width == "always":
            raise InputError("bsdf.convention", "printed shares or widths", "a convention with shares v and 1 - v")

    def __call__(self, contexts: Context) -> Tensor:
        """int f domega `[B, C]` for contexts `[B]`."""
        contexts = contexts.to(torch.float64)
        starts = range(0, len(contexts), _AT_ONCE)
        with torch.no_grad():
            return torch.cat([self._some(contexts[start : start + _AT_ONCE]) for start in starts])

    def check(self, contexts: Context, rtol: float = 1e-6) -> float:
        """Largest difference from `dsfit.reference` at these contexts, relative to the norm of the integral."""
        from dsfit.quality import reference

        exact = reference(self.integrand, contexts, rtol=rtol).value
        size = torch.linalg.vector_norm(exact, dim=-1)
        return float((torch.linalg.vector_norm(self(contexts) - exact, dim=-1) / size).max())

    def _azimuths(self, diff: Tensor) -> Tensor:
        """int N_p dphi and int N^G_p dphi over the circle, `[M, 2, 3, C]`."""
        edges = support_edges(self.bsdf.fiber, diff)
        shifted = [(edges - HALF_PI).abs(), math.pi - (edges - HALF_PI).abs()]
        fixed = torch.tensor([0.0, HALF_PI, math.pi], dtype=diff.dtype).expand(*diff.shape, 3)
        ends = torch.sort(torch.cat([edges, *shifted, fixed], dim=-1).clamp(0.0, math.pi), dim=-1).values
        x, w = gauss_legendre(_AZIMUTHS)
        angle = (math.pi / 4) * (1 + x)
        low, width = ends[..., :-1, None], (ends[..., 1:] - ends[..., :-1])[..., None]
        phi = (low + width * torch.sin(angle) ** 2).flatten(-2)
        weight = (2 * width * w * (math.pi / 4) * torch.sin(2 * angle)).flatten(-2)
        laws = (self.bsdf.azimuthal, self.bsdf.azimuthal_scattered)
        wide = diff.unsqueeze(-1).expand_as(phi)
        return torch.stack([torch.einsum("mq,mqpc->mpc", weight, law(wide, phi)) for law in laws], dim=1)

    def _some(self, contexts: Context) -> Tensor:
        bsdf: DualScattering = self.bsdf
        nodes = [panel_points(theta_breaks(bsdf, t), _POINTS) for t in contexts.theta_r]
        count = max(len(x) for x, _ in nodes)
        theta_i, weight = (
            torch.stack([torch.nn.functional.pad(pair[k], (0, count - len(pair[k]))) for pair in nodes]) for k in (0, 1)
        )
        theta_r, n, v = (x.unsqueeze(-1).expand_as(theta_i) for x in (contexts.theta_r, contexts.n, contexts.v))
        diff, half = theta_diff(theta_i, theta_r), theta_half(theta_i, theta_r)
        around = self._around(diff.abs()).reshape(*diff.shape, 2, 3, -1)
        average = bsdf.averages(bsdf._average_angle(theta_i, theta_r))
        variance_f = bsdf._variance_f(average, n, theta_i)
        circle = 2 * math.pi if bsdf.convention.back_azimuth == "all" else math.pi
        factor = math.pi if bsdf.convention.back_factor == "pi" else 1.0

        def back(widening: Tensor) -> Tensor:
            return circle * bsdf.d_b * bsdf._back(theta_i, theta_r, torch.zeros_like(theta_i), average, widening)

        lobes = longitudinal.lobes(bsdf.fiber, half).unsqueeze(-1)
        direct = (lobes * around[..., 0, :, :]).sum(-2) * bsdf._projection(diff) + back(torch.zeros_like(variance_f))
        wide = longitudinal.scattered_lobes(bsdf.fiber, half, variance_f)
        scattered = (wide * around[..., 1, :, :]).sum(-2) * bsdf._projection(diff) + factor * back(variance_f)
        scattered = scattered * bsdf._transmittance(average, n)
        scattered = scattered * bsdf.d_f ** (bsdf.convention.density_power - 1)
        value = v.unsqueeze(-1) * direct + (1 - v).unsqueeze(-1) * scattered
        mass = (weight * cos_inclination(theta_i) ** 2).unsqueeze(-1)
        return (value * mass).sum(-2) * self.integrand.light.radiance.to(value)
