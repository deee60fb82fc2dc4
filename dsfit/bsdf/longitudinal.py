"""Longitudinal scattering: normalised Gaussians in theta_h."""

from __future__ import annotations

import torch
from torch import Tensor

from dsfit.bsdf.fiber import Fiber
from dsfit.special import log_gauss


def lobes(fiber: Fiber, theta_h: Tensor) -> Tensor:
    """M_p = g(theta_h - alpha_p; beta_p) for R, TT, TRT, `[..., 3]`, per radian of theta_h (eq 12, without c_M)."""
    return torch.exp(log_gauss(theta_h.unsqueeze(-1) - fiber.alpha, fiber.beta))


def scattered_lobes(fiber: Fiber, theta_h: Tensor, variance_f: Tensor) -> Tensor:
    """M^G_p = g(theta_h - alpha_p; sqrt(beta_p^2 + sigma_f^2)), `[..., 3, C]`, for sigma_f^2 `[..., C]` (eq 10)."""
    std = torch.sqrt(fiber.beta.unsqueeze(-1) ** 2 + variance_f.unsqueeze(-2))
    return torch.exp(log_gauss(theta_h[..., None, None] - fiber.alpha.unsqueeze(-1), std))
