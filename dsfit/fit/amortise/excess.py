"""The excess of an amortised proposal on the grids of `Targets`."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from dsfit.fit.amortise.targets import Targets
from dsfit.frame import cos_inclination
from dsfit.proposals.amortised import AmortisedProposal, MixtureShape
from dsfit.proposals.split_lobe import SplitGaussianInclination

_AT_ONCE = 32


def density(targets: Targets, shape: MixtureShape, defensive: float) -> Tensor:
    """`sum_k w_k g_k(theta_i) A_k(phi | theta_i) + defensive cos(theta_i) / (4 pi)` per radian of theta_i and phi,
    `[R, J, L, M]`, for shapes `[R, M, K]`."""
    columns = (shape.mode[:, None], shape.below[:, None], shape.above[:, None])
    lobes = SplitGaussianInclination(targets.context.theta_r[:, None, :1, None], *columns)
    log_lobes = lobes.log_prob(targets.theta[:, :, None, None]) + shape.log_weights[:, None]
    sphere = (defensive / (4 * math.pi)) * cos_inclination(targets.theta)
    return targets.azimuth @ torch.exp(log_lobes).transpose(-1, -2) + sphere[:, :, None, None]


def excess_at(targets: Targets, proposal: AmortisedProposal) -> Tensor:
    """`sum w (p* - p)^2 / p` `[R, M]`: the excess of every context by its quadrature, never negative, differentiable
    in the proposal's parameters."""
    p = density(targets, proposal.shape(targets.context), proposal.defensive)
    return (targets.weight[..., None] * (targets.target - p) ** 2 / p).sum((1, 2))


@torch.no_grad()
def all_excesses(targets: Targets, proposal: AmortisedProposal) -> Tensor:
    """The same for many inclinations, a few at a time, detached."""
    rows = range(0, len(targets), _AT_ONCE)
    return torch.cat([excess_at(targets[i : i + _AT_ONCE], proposal) for i in rows])
