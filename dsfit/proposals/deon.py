"""Importance sampling of hair by offsets over the fibre (d'Eon et al. 2013), extended to dual scattering."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from dsfit.bsdf.dual_scattering import DualScattering
from dsfit.context import Context
from dsfit.errors import as_number
from dsfit.frame import reachable
from dsfit.proposals.azimuth import Scattered
from dsfit.proposals.base import Azimuthal, Distribution, ProductDistribution, Proposal
from dsfit.proposals.deon_azimuth import OffsetFamily, TurnedOffset
from dsfit.proposals.inclination import TruncatedGaussianInclination
from dsfit.proposals.mixture import MixtureDistribution
from dsfit.proposals.ou_azimuth import SCALE, GlintCosine
from dsfit.proposals.ou_lobes import ContextLobes
from dsfit.proposals.parameters import STD_BOUNDS
from dsfit.proposals.uniform import BackHalf, UniformAzimuth, UniformSphere

_GLINT = 0.9  # share of the glints in the law that covers them; the rest is cos(phi/2), so that no tail is left bare


class DeonProposal(Proposal):
    """The lobe is chosen by attenuation at a sampled offset, phi follows from Snell's law, theta_h is Gaussian.

    Direct light: `OffsetFamily`, and a share of TRT for the Gaussian glints that replace the caustic, which offsets do
    not reach. Scattered light: lobes in proportion to their energy, azimuths by a turned offset (`TurnedOffset`),
    widths sqrt(beta_p^2 + n beta_f^2). Back scattering: uniform azimuth. A defensive share of the uniform sphere.
    Shares and widths in closed form at every context (`ContextLobes`); nothing is fitted.

    The offset density of TRT is infinite at the caustic, where the integrand is not: weights only fall to 0 there.

    Args:
        bsdf: a round fibre with its own azimuths.
        glint_share: share of TRT's energy that covers the glints, in (0, 1).
        defensive: share of the uniform sphere, in (0, 1).

    Raises:
        InputError: a batch of fibres, or a number out of range.
    """

    eta: Tensor
    sigma_a: Tensor

    def __init__(self, bsdf: DualScattering, glint_share: float = 0.8, defensive: float = 0.05) -> None:
        super().__init__()
        self.glint_share = as_number("glint_share", glint_share, 0.0, 1.0, open_low=True, open_high=True)
        self.defensive = as_number("defensive", defensive, 0.0, 1.0, open_low=True, open_high=True)
        self.lobes = ContextLobes(bsdf)
        fiber = bsdf.fiber
        self.absorption = bsdf.convention.absorption
        self.register_buffer("eta", fiber.eta.detach().to(torch.float64))
        self.register_buffer("sigma_a", fiber.sigma_a.detach().to(torch.float64))
        glint = GlintCosine(fiber.eta, SCALE * float(fiber.caustic_width), _GLINT)
        turned: list[Azimuthal] = [TurnedOffset(name, fiber.eta) for name in ("R", "TT", "TRT")]
        back = BackHalf() if bsdf.convention.back_azimuth == "back" else UniformAzimuth()
        self.laws = torch.nn.ModuleList([glint, *turned, Scattered(glint), back])
        self.sphere = UniformSphere()

    def forward(self, context: Context) -> MixtureDistribution:
        shares, centers, widths = self.lobes(context)
        center, width = centers.clamp(-math.pi / 2, math.pi / 2).unbind(-1), widths.clamp(*STD_BOUNDS).unbind(-1)
        laws = [TruncatedGaussianInclination(context.theta_r, x, s) for x, s in zip(center, width, strict=True)]
        order = (2, 3, 4, 5, 5, 6)
        parts: list[Distribution] = [self._family(context, tuple(laws[:3]), center[:3])]
        parts += [ProductDistribution(context, laws[k], law(context)) for k, law in zip(order, self.laws, strict=True)]
        parts.append(self.sphere(context))
        return MixtureDistribution(parts, self._log_weights(shares))

    def _family(
        self, context: Context, laws: tuple[TruncatedGaussianInclination, ...], center: tuple[Tensor, ...]
    ) -> OffsetFamily:
        low, high = reachable(context.theta_r)
        guess = tuple((context.theta_r - torch.minimum(torch.maximum(x, low), high)) for x in center)
        eta, sigma_a = self.eta.to(context.dtype), self.sigma_a.to(context.dtype)
        return OffsetFamily(context, laws, guess, eta, sigma_a, self.absorption)

    def _log_weights(self, shares: Tensor) -> Tensor:
        """log weights `[*batch, 8]`: the direct family, its glints, turned R, TT, TRT, their glints, back, sphere."""
        taken, left = math.log(self.glint_share), math.log1p(-self.glint_share)
        r, tt, trt, *scattered, back = shares.unbind(-1)
        family = torch.logsumexp(torch.stack([r, tt, trt + left], dim=-1), dim=-1)
        columns = [family, trt + taken, *scattered[:2], scattered[2] + left, scattered[2] + taken, back]
        weights = torch.stack(columns, dim=-1) + math.log1p(-self.defensive)
        return torch.cat([weights, torch.full_like(weights[..., :1], math.log(self.defensive))], dim=-1)
