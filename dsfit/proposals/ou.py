"""Analytic importance sampling of hair with Cauchy lobes (Ou et al. 2012), extended to dual scattering."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from dsfit.bsdf.dual_scattering import DualScattering
from dsfit.context import Context
from dsfit.errors import as_number
from dsfit.proposals.azimuth import CosineHalf, Scattered
from dsfit.proposals.base import Azimuthal, ProductDistribution, Proposal
from dsfit.proposals.cauchy_lobe import CauchyInclination
from dsfit.proposals.mixture import MixtureDistribution
from dsfit.proposals.ou_azimuth import SCALE, GlintCosine, WrappedCauchy
from dsfit.proposals.ou_lobes import ContextLobes
from dsfit.proposals.parameters import STD_BOUNDS
from dsfit.proposals.uniform import BackHalf, UniformAzimuth


class OuProposal(Proposal):
    """Lobes drawn in proportion to their energy, theta_h from Cauchy laws, azimuths from analytic laws.

    R: cos(phi/2). TT: Cauchy about phi = pi. TRT: cos(phi/2) with Cauchy glints at the caustic. Scattered lobes: the
    same azimuths turned by a uniform angle in [-pi/2, pi/2] (N^G of eq 11) and widened by sqrt(n) beta_f. Back
    scattering: uniform azimuth. Shares, centres and widths in closed form at every context (`ContextLobes`); nothing is
    fitted and no tail needs a defensive share, for Cauchy laws dominate the integrand's Gaussians.

    Args:
        bsdf: whose lobes these are.
        scale: Cauchy scale over Gaussian standard deviation, in [0.1, 10]; the default is the best for a Gaussian.
        glint_share: share of the glints in TRT.

    Raises:
        InputError: a batch of fibres, or a number out of range.
    """

    def __init__(self, bsdf: DualScattering, scale: float = SCALE, glint_share: float = 0.6) -> None:
        super().__init__()
        self.scale = as_number("scale", scale, 0.1, 10.0)
        self.lobes = ContextLobes(bsdf)
        fiber = bsdf.fiber
        trt = GlintCosine(fiber.eta, self.scale * float(fiber.caustic_width), glint_share)
        laws: list[Azimuthal] = [CosineHalf(), WrappedCauchy(self.scale * float(fiber.gamma_tt)), trt]
        back = BackHalf() if bsdf.convention.back_azimuth == "back" else UniformAzimuth()
        self.laws = torch.nn.ModuleList([*laws, *(Scattered(law) for law in laws), back])

    def forward(self, context: Context) -> MixtureDistribution:
        shares, centers, widths = self.lobes(context)
        scales = (self.scale * widths).clamp(*STD_BOUNDS)
        parts = []
        for law, center, scale in zip(self.laws, centers.unbind(-1), scales.unbind(-1), strict=True):
            parts.append(ProductDistribution(context, _lobe(context, center, scale), law(context)))
        return MixtureDistribution(parts, shares)


def _lobe(context: Context, center: Tensor, scale: Tensor) -> CauchyInclination:
    limit = math.pi / 2
    return CauchyInclination(context.theta_r, center.clamp(-limit, limit), scale)
