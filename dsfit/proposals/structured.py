"""The structured family: the integrand's own lobes as a mixture, with shapes that a fit adjusts."""

from __future__ import annotations

import math
import weakref

import torch
from torch import Tensor

from dsfit.bsdf.attenuation import lobe_energies
from dsfit.bsdf.azimuthal import refractions
from dsfit.bsdf.dual_scattering import DualScattering
from dsfit.context import Context
from dsfit.frame import HALF_PI, cos_inclination, reachable
from dsfit.proposals.base import Product, Proposal
from dsfit.proposals.conditional import FiberAzimuth, lobe_azimuths
from dsfit.proposals.mixture import Mixture
from dsfit.proposals.parameters import MEAN_BOUNDS
from dsfit.proposals.split_lobe import SplitGaussianLobe
from dsfit.proposals.uniform import BackHalf, UniformAzimuth
from dsfit.special import truncated_normal_icdf

_POINTS = 65
_TABLES: weakref.WeakKeyDictionary[DualScattering, dict[bool, list[FiberAzimuth]]] = weakref.WeakKeyDictionary()


def azimuth_tables(bsdf: DualScattering, scattered: bool) -> list[FiberAzimuth]:
    """`lobe_azimuths`, made once per BSDF."""
    known = _TABLES.setdefault(bsdf, {})
    if scattered not in known:
        known[scattered] = lobe_azimuths(bsdf, scattered=scattered)
    return known[scattered]


class StructuredProposal(Mixture):
    """Mixture of the integrand's own lobes: theta_i from split Gaussians in theta_h, phi from the lobe's own azimuth
    given theta_diff.

    Components: R, TT, TRT where some light is direct (v > 0); their widened forms with azimuths N^G where some is
    scattered (v < 1); back scattering where d_b > 0; one broad lobe; and the defensive share of the uniform sphere.
    What the contexts do not need is left out. Components start at the moments of the corresponding part of the
    integrand, so that even unfitted the mixture is close; a fit then adjusts weights, modes and widths (4 parameters a
    component).

    Args:
        bsdf: the BSDF whose azimuths and averages shape the mixture.
        context: the context it starts from; of a batch, the mean is taken.
        defensive: share of the uniform sphere; bounds every weight by 4 pi |f| / defensive.
        broad: initial share of the broad lobe.
    """

    def __init__(self, bsdf: DualScattering, context: Context, defensive: float = 0.001, broad: float = 0.01) -> None:
        with torch.no_grad():
            parts = _Start(bsdf, context.reshape(-1).to(torch.float64)).components()
        names = [name for name, _, _ in parts]
        total = sum(energy for _, energy, _ in parts)
        floor = 1e-4
        weights = [floor + (1 - broad) * energy / total for _, energy, _ in parts]
        wide = Product(SplitGaussianLobe(0.0, 0.6, 0.6), UniformAzimuth())
        super().__init__([*(p for _, _, p in parts), wide], [*weights, broad], defensive)
        self.names = (*names, "broad")


class _Start:
    """Moments of each part of the integrand, which the components start from."""

    def __init__(self, bsdf: DualScattering, context: Context) -> None:
        self.bsdf, self.context = bsdf, context
        self.low, self.high = reachable(context.theta_r)
        self.guess = bsdf.averages(-context.theta_r)

    def components(self) -> list[tuple[str, float, Proposal]]:
        """Name, energy and proposal of every component that the contexts need."""
        found: list[tuple[str, float, Proposal]] = []
        direct, scattered = bool((self.context.v > 0).any()), bool((self.context.v < 1).any())
        fiber = self.bsdf.fiber
        n = self.context.n[:, None]
        variance_f = (n * self.guess.beta_f**2).mean(-1)
        for k, name in enumerate(("R", "TT", "TRT")):
            mean, std = fiber.alpha[k].expand_as(self.low), fiber.beta[k].expand_as(self.low)
            if direct:
                law = azimuth_tables(self.bsdf, False)[k]
                found.append(self._component(name, k, mean, std, law, self.context.v, 0 * n))
            if scattered:
                law = azimuth_tables(self.bsdf, True)[k]
                wide = torch.sqrt(std**2 + variance_f)
                found.append(self._component(f"{name}_scattered", k, mean, wide, law, 1 - self.context.v, n))
        if bool(self.bsdf.d_b > 0):
            law = BackHalf() if self.bsdf.convention.back_azimuth == "back" else UniformAzimuth()
            shift = self.guess.delta_b.mean(-1)
            spread = torch.sqrt(self.guess.sigma_b.mean(-1) ** 2 + variance_f * (1 - self.context.v))
            found.append(self._component("back", None, shift, spread, law, self.context.v, n))
        return found

    def _component(
        self,
        name: str,
        k: int | None,
        mean: Tensor,
        std: Tensor,
        law,
        share: Tensor,
        n: Tensor,  # noqa: ANN001
    ) -> tuple[str, float, Proposal]:
        """Reweight a lobe `N(mean, std)` by what multiplies it in the integrand, and match its moments."""
        u = (torch.arange(_POINTS, dtype=torch.float64) + 0.5)[:, None] / _POINTS
        theta_h = truncated_normal_icdf(u, mean, std, self.low, self.high)
        mass = torch.special.ndtr((self.high - mean) / std) - torch.special.ndtr((self.low - mean) / std)
        factor = self._factor(theta_h, k, share, n) * (mass / _POINTS).clamp_min(1e-12)
        energy = factor.sum(0)
        weight = factor / energy.clamp_min(1e-300)
        moved = (weight * theta_h).sum(0) - theta_h.mean(0)
        center = (weight * theta_h).sum(0)
        spread = ((weight * (theta_h - center) ** 2).sum(0) / theta_h.var(0, correction=0).clamp_min(1e-12)).sqrt()
        limit = 0.98 * MEAN_BOUNDS[1]
        mode = (mean + moved).mean().clamp(-limit, limit)
        width = (std * spread.clamp(0.3, 1.5)).mean().clamp(1e-4, 2.0)
        return name, float(energy.mean()), Product(SplitGaussianLobe(mode, width, width), law)

    def _factor(self, theta_h: Tensor, k: int | None, share: Tensor, n: Tensor) -> Tensor:
        """What multiplies the lobe: energy x cos^2(theta_i)/cos^2(theta_diff) x transmittance, norm over channels."""
        bsdf, theta_r = self.bsdf, self.context.theta_r
        theta_i = (2 * theta_h - theta_r).clamp(-HALF_PI, HALF_PI)
        diff = (theta_r - theta_i) / 2
        projection = cos_inclination(theta_i) ** 2 / cos_inclination(diff) ** 2
        average = bsdf.averages(theta_i)
        passed = torch.exp(n * torch.log(average.a_f.clamp_min(1e-300)))
        if k is None:
            v = self.context.v[:, None]
            strength = average.A_b * (v + (1 - v) * passed * bsdf.d_f) * 2 * bsdf.d_b
        else:
            bent = refractions(bsdf.fiber, diff, torch.full_like(diff, math.pi / 4))
            energies = lobe_energies(bent, bsdf.fiber.sigma_a, bsdf.convention.absorption)[..., k, :]
            strength = share[:, None] * passed * energies
        return torch.linalg.vector_norm(strength, dim=-1) * projection
