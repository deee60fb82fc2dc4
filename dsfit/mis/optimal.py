"""The linear system behind the optimal weights, from sample moments (cross-fitted) or from quadrature nodes.

Everything is in terms of g = F / P (`[..., C]`) and r_k = p_k / P (`[..., S]`) with P = sum_k c_k p_k. Both are linear
in the estimator, `sum_k alpha_k + sum_s c_s mean_s[g - r . alpha]`, so running moments of (g, r) are all a pass over
the samples has to keep.
"""

from __future__ import annotations

import torch
from torch import Tensor


def solve_alpha(matrix: Tensor, vector: Tensor, fractions: Tensor, rcond: float | None = None) -> Tensor:
    """Least-squares solution `[..., S, C]` of `A alpha = b` by a scaled pseudo-inverse.

    `A [..., S, S]` is scaled to D A D with D = diag(sqrt c): its exact eigenvalues lie in [0, 1] and the largest is 1
    (A c = 1), which gives the cut-off `rcond` (default 100 eps) a meaning free of units. Strategies with c_k = 0 get
    alpha_k = 0.
    """
    scale = torch.sqrt(fractions)
    scaled = scale.unsqueeze(-1) * matrix * scale
    values, vectors = torch.linalg.eigh(0.5 * (scaled + scaled.mT))
    cut = torch.finfo(matrix.dtype).eps * 100 if rcond is None else rcond
    keep = values > cut * values[..., -1:].clamp_min(torch.finfo(matrix.dtype).tiny)
    inverse = torch.where(keep, 1 / torch.where(keep, values, 1.0), 0.0)
    rotated = vectors.mT @ (scale.unsqueeze(-1) * vector)
    return scale.unsqueeze(-1) * (vectors @ (inverse.unsqueeze(-1) * rotated))


def cross_fit(second: Tensor, fractions: Tensor, channels: int, rcond: float | None = None) -> Tensor:
    """alpha of every fold from all other folds, `[K, *batch, S, C]`.

    The fold's own samples never enter its alpha, and the estimator is unbiased for any fixed alpha, so each fold's
    estimate is unbiased and so is their mean.

    Args:
        second: for each fold, sum_s c_s E_s[y y^T] `[K, *batch, C + S, C + S]`, y = (g, r).
        fractions: c_k `[S]`.
        channels: C.
        rcond: see `solve_alpha`.
    """
    others = (second.sum(dim=0, keepdim=True) - second) / (second.shape[0] - 1)
    return solve_alpha(others[..., channels:, channels:], others[..., channels:, :channels], fractions, rcond).detach()


def quadrature_alpha(g: Tensor, r: Tensor, mass: Tensor, fractions: Tensor, rcond: float | None = None) -> Tensor:
    """alpha `[*batch, S, C]` from g `[Q, *batch, C]`, r `[Q, *batch, S]`, mass = node weight x P `[Q, *batch]`."""
    weighted = r * mass.unsqueeze(-1)
    matrix = torch.einsum("q...s,q...t->...st", weighted, r)
    return solve_alpha(matrix, torch.einsum("q...s,q...c->...sc", weighted, g), fractions, rcond)
