"""Where, in theta_i, the BSDF has peaks, flanks and jumps: panel ends for quadrature."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from dsfit.bsdf.dual_scattering import DualScattering
from dsfit.frame import HALF_PI
from dsfit.quadrature import merge_breaks

_FLANKS = (-8.0, -4.0, -2.0, 0.0, 2.0, 4.0, 8.0)
_REGULAR = (-1.2, -0.7, 0.0, 0.7, 1.2)


def theta_breaks(bsdf: DualScattering, theta_r: Tensor, extra: list[float] | None = None) -> Tensor:
    """Increasing theta_i from -pi/2 to pi/2 for one viewing inclination: lobe centres and flanks, back scattering,
    jumps of TRT, `extra`.
    """
    fiber, theta_r = bsdf.fiber, theta_r.detach()
    alpha, beta = fiber.alpha.detach().to(theta_r), fiber.beta.detach().to(theta_r)
    steps = torch.tensor(_FLANKS, dtype=theta_r.dtype)
    terms = bsdf.terms
    lobes = sorted({*terms.direct_lobes, *terms.scattered_lobes})
    alpha, beta = alpha[..., lobes], beta[..., lobes]
    points = [(2 * alpha[..., None] + 2 * beta[..., None] * steps - theta_r).flatten()]
    if "back" in (*terms.direct, *terms.scattered):
        average = bsdf.averages(-theta_r)
        center, width = (2 * average.delta_b - theta_r).detach().flatten(), 4 * average.sigma_b.detach().flatten()
        points += [center, center - width, center + width]
    if bsdf.convention.back_argument == "theta_diff+theta_r":
        points.append(3 * theta_r.reshape(1))
    if 2 in lobes:
        points += [theta_r + 2 * sign * t for t in _jumps(bsdf) for sign in (-1, 1)]
    points.append(torch.tensor([*_REGULAR, *(extra or [])], dtype=theta_r.dtype))
    return merge_breaks(torch.cat([p.reshape(-1) for p in points]), -HALF_PI, HALF_PI, 1e-7)


def _jumps(bsdf: DualScattering) -> list[Tensor]:
    """theta_diff at which eta' = sqrt 2, 2, or the end of the glint's fade, for a round section."""
    fiber = bsdf.fiber
    found = []
    for target in (math.sqrt(2.0), 2.0, 2.0 + float(fiber.caustic_fade.detach().max())):
        cos2 = (float(fiber.eta.detach().max()) ** 2 - 1) / (target * target - 1)
        if 0 < cos2 < 1:
            found.append(torch.acos(torch.tensor(math.sqrt(cos2), dtype=fiber.dtype)).reshape(1))
    return found
