"""Longitudinal scattering: normalised Gaussians in theta_h."""

from __future__ import annotations

import torch
from torch import Tensor

from dsfit.bsdf.fiber import Fiber
from dsfit.special import log_gauss


def lobes(fiber: Fiber, theta_h: Tensor, which: tuple[int, ...] = (0, 1, 2)) -> Tensor:
    """M_p = g(theta_h - alpha_p; beta_p) for `which` of R, TT, TRT, `[..., len(which)]`, per radian of theta_h (eq 12,
    without c_M)."""
    alpha, beta = _those(fiber, which)
    return torch.exp(log_gauss(theta_h.unsqueeze(-1) - alpha, beta))


def scattered_lobes(fiber: Fiber, theta_h: Tensor, variance_f: Tensor, which: tuple[int, ...] = (0, 1, 2)) -> Tensor:
    """M^G_p = g(theta_h - alpha_p; sqrt(beta_p^2 + sigma_f^2)), `[..., len(which), C]`, for sigma_f^2 `[..., C]` (eq
    10)."""
    alpha, beta = _those(fiber, which)
    std = torch.sqrt(beta.unsqueeze(-1) ** 2 + variance_f.unsqueeze(-2))
    return torch.exp(log_gauss(theta_h[..., None, None] - alpha.unsqueeze(-1), std))


def _those(fiber: Fiber, which: tuple[int, ...]) -> tuple[Tensor, Tensor]:
    if which == (0, 1, 2):
        return fiber.alpha, fiber.beta
    return fiber.alpha[..., list(which)], fiber.beta[..., list(which)]
