"""The structured family: the integrand's own lobes as a mixture, with shapes that a fit adjusts."""

from __future__ import annotations

import math
import weakref
from collections.abc import Mapping

import torch
from torch import Tensor

from dsfit.bsdf.attenuation import lobe_energies
from dsfit.bsdf.azimuthal import refractions
from dsfit.bsdf.breaks import theta_breaks
from dsfit.bsdf.dual_scattering import DualScattering
from dsfit.bsdf.forward import event_count, log_transmittance
from dsfit.context import Context
from dsfit.frame import cos_inclination, theta_diff, theta_half
from dsfit.proposals.base import Azimuthal, Product, Proposal
from dsfit.proposals.conditional import FiberAzimuth, lobe_azimuths
from dsfit.proposals.mixture import Mixture
from dsfit.proposals.parameters import MEAN_BOUNDS
from dsfit.proposals.split_lobe import SplitGaussianLobe
from dsfit.proposals.uniform import BackHalf, UniformAzimuth
from dsfit.quadrature import panel_points
from dsfit.special import log_gauss

_POINTS = 8
_TABLES: weakref.WeakKeyDictionary[DualScattering, dict[bool, list[FiberAzimuth]]] = weakref.WeakKeyDictionary()


def azimuth_tables(bsdf: DualScattering, scattered: bool) -> list[FiberAzimuth]:
    """`lobe_azimuths`, made once per BSDF, whatever its terms."""
    known = _TABLES.setdefault(bsdf.origin, {})
    if scattered not in known:
        known[scattered] = lobe_azimuths(bsdf.origin, scattered=scattered)
    return known[scattered]


class StructuredProposal(Mixture):
    """Mixture of the integrand's own lobes: theta_i from split Gaussians in theta_h, phi from the lobe's own azimuth
    given theta_diff.

    Components: R, TT, TRT where some light is direct (v > 0); their widened forms with azimuths N^G where some is
    scattered (v < 1); back scattering where d_b > 0; one broad lobe; and the defensive share of the uniform sphere.
    What the contexts or the BSDF's terms do not need is left out. Components start at the moments of the corresponding
    part of the integrand, so that even unfitted the mixture is close; a fit then adjusts weights, modes and widths (4
    parameters a component).

    Args:
        bsdf: the BSDF whose azimuths and averages shape the mixture.
        context: the context it starts from; of a batch, the mean is taken.
        defensive: share of the uniform sphere; bounds every weight by 4 pi |f| / defensive.
        broad: initial share of the broad lobe.
        extra: further proposals by name that the mixture takes in, such as `{"light": light.proposal()}`, each starting
            with `extra_share`.
        extra_share: initial share of each of them.

    Example:
        >>> import dsfit
        >>> bsdf = dsfit.DualScattering(dsfit.Fiber.preset("blond"), precision="table")
        >>> context = dsfit.Context(0.3, n=0.0)
        >>> proposal = dsfit.StructuredProposal(bsdf, context)
        >>> proposal.names
        ('R', 'TT', 'TRT', 'back', 'broad')
        >>> round(float(dsfit.excess(dsfit.Integrand(bsdf), proposal, context, 1e-2).value), 3)
        0.008
    """

    def __init__(
        self,
        bsdf: DualScattering,
        context: Context,
        defensive: float = 0.001,
        broad: float = 0.01,
        *,
        extra: Mapping[str, Proposal] | None = None,
        extra_share: float = 0.2,
    ) -> None:
        with torch.no_grad():
            parts = _Start(bsdf, context.reshape(-1).to(torch.float64)).components()
        names = [name for name, _, _ in parts]
        total = sum(energy for _, energy, _ in parts)
        floor = 1e-4
        weights = [floor + (1 - broad) * energy / total for _, energy, _ in parts]
        wide = Product(SplitGaussianLobe(0.0, 0.6, 0.6), UniformAzimuth())
        added = dict(extra or {})
        components = [*(p for _, _, p in parts), wide, *added.values()]
        super().__init__(components, [*weights, broad, *(extra_share for _ in added)], defensive)
        self.names = (*names, "broad", *added)


class _Start:
    """Longitudinal marginals of each part of the integrand, whose moments the components start from.

    Each marginal is evaluated on Gauss panels that follow the lobes, for every context of the batch.
    """

    def __init__(self, bsdf: DualScattering, context: Context) -> None:
        self.bsdf, self.context = bsdf, context
        nodes = [panel_points(theta_breaks(bsdf, t), _POINTS) for t in context.theta_r]
        count = max(len(x) for x, _ in nodes)
        self.theta_i = torch.stack([torch.nn.functional.pad(x, (0, count - len(x))) for x, _ in nodes])
        self.weight = torch.stack([torch.nn.functional.pad(w, (0, count - len(w))) for _, w in nodes])
        theta_r = context.theta_r[:, None]
        self.theta_h, self.diff = theta_half(self.theta_i, theta_r), theta_diff(self.theta_i, theta_r)
        self.average = bsdf.averages(self.theta_i)
        self.v, n, law = context.v[:, None, None], context.n[:, None, None], bsdf.convention.transmittance
        self.variance_f = event_count(self.average.a_f, n, law) * self.average.beta_f**2
        log_a_f = torch.log(self.average.a_f.clamp_min(1e-300))
        self.passed = bsdf.d_f * torch.exp(log_transmittance(log_a_f, n, law))

    def components(self) -> list[tuple[str, float, Proposal]]:
        """Name, energy and proposal of every component that the contexts need."""
        bsdf, fiber = self.bsdf, self.bsdf.fiber
        found: list[tuple[str, float, Proposal]] = []
        terms = bsdf.terms
        direct, scattered = bool((self.context.v > 0).any()), bool((self.context.v < 1).any())
        backs = (direct and "back" in terms.direct, scattered and "back" in terms.scattered)
        bent = refractions(fiber, self.diff, torch.full_like(self.diff, math.pi / 4))
        energies = lobe_energies(bent, fiber.sigma_a, bsdf.convention.absorption)
        theta_h = self.theta_h.unsqueeze(-1)
        for k, name in enumerate(("R", "TT", "TRT")):
            x, energy, beta = theta_h - fiber.alpha[k], energies[..., k, :], fiber.beta[k]
            if direct and name in terms.direct:
                part = self.v * energy * torch.exp(log_gauss(x, beta))
                found.append(self._component(name, part, azimuth_tables(bsdf, False)[k]))
            if scattered and name in terms.scattered:
                part = (1 - self.v) * self.passed * energy
                part = part * torch.exp(log_gauss(x, torch.sqrt(beta**2 + self.variance_f)))
                found.append(self._component(f"{name}_scattered", part, azimuth_tables(bsdf, True)[k]))
        if bool(bsdf.d_b > 0) and any(backs):
            found.append(self._component("back", self._back(theta_h), self._back_azimuth()))
        return found

    def _back(self, theta_h: Tensor) -> Tensor:
        average, x = self.average, theta_h - self.average.delta_b
        terms = self.bsdf.terms
        widened = torch.sqrt(average.sigma_b**2 + self.variance_f)
        near = ("back" in terms.direct) * self.v * torch.exp(log_gauss(x, average.sigma_b))
        far = ("back" in terms.scattered) * (1 - self.v) * self.passed * torch.exp(log_gauss(x, widened))
        around = 4 if self.bsdf.convention.back_azimuth == "all" else 2
        return around * self.bsdf.d_b * average.A_b * (near + far)

    def _back_azimuth(self) -> Azimuthal:
        return BackHalf() if self.bsdf.convention.back_azimuth == "back" else UniformAzimuth()

    def _component(self, name: str, part: Tensor, law: Azimuthal) -> tuple[str, float, Proposal]:
        """A split Gaussian with the mean of the marginal, and the root mean squares on either side of it."""
        projection = cos_inclination(self.theta_i) ** 2 / cos_inclination(self.diff) ** 2
        mass = torch.linalg.vector_norm(part, dim=-1) * projection * self.weight
        energy = mass.sum(-1, keepdim=True)
        share = mass / energy.clamp_min(1e-300)
        center = (share * self.theta_h).sum(-1, keepdim=True)
        widths = []
        for side in (self.theta_h < center, self.theta_h >= center):
            half = torch.where(side, share, 0.0)
            square = (half * (self.theta_h - center) ** 2).sum(-1) / half.sum(-1).clamp_min(1e-12)
            widths.append(torch.sqrt(square).mean().clamp(1e-4, 2.0))
        limit = 0.98 * MEAN_BOUNDS[1]
        lobe = SplitGaussianLobe(center.mean().clamp(-limit, limit), *widths)
        return name, float(energy.mean()), Product(lobe, law)
