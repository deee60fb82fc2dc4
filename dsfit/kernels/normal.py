"""The inverse of the normal law's upper tail in float32."""

from __future__ import annotations

import torch
from torch import Tensor

# x / (1 - y) in powers of w, |relative error| < 8e-8 for w in [0, 6.25]
_BODY = (
    1.253314044, 0.3281200195, 0.01631625781, -0.003268174582, -0.0002139362175, 8.208768495e-05, -6.607918076e-07,
    -1.591124583e-06, 1.88914308e-07, -7.155819616e-09,
)  # fmt: skip
# x in powers of (sqrt w - 4.1) / 1.6, |relative error| < 9e-8 for sqrt w in [2.5, 5.7]
_TAIL = (
    5.573054694, 2.28473466, 0.003671877968, -0.004273630661, 0.00237360244, -0.001169801392, 0.0004535794612,
    -7.316103615e-05,
)  # fmt: skip
_SPLIT = 6.25


def upper_quantile(y: Tensor) -> Tensor:
    """x >= 0 with 2 Q(x) = y for y in (0, 1], Q the upper tail of the standard normal law; exact to a few ulp for y >=
    1e-14, beyond which x stays at the value there.

    Two polynomials in w = -log(y (2 - y)), as in Giles (2010), fitted anew for these ranges.
    """
    w = -torch.log((y * (2 - y)).clamp_min(1e-14))
    body = torch.full_like(w, _BODY[-1])
    for value in _BODY[-2::-1]:
        body = body * w + value
    t = (torch.sqrt(w.clamp_min(_SPLIT)) - 4.1) * (1 / 1.6)
    tail = torch.full_like(t, _TAIL[-1])
    for value in _TAIL[-2::-1]:
        tail = tail * t + value
    return torch.where(w < _SPLIT, body * (1 - y), tail)
