"""What depends on the shading context alone: the mixture of each context, ready to be evaluated and drawn from."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from dsfit.frame import reachable
from dsfit.kernels.layout import FIELDS

_REACH = 4.0


@dataclass(frozen=True)
class Contexts:
    """Prepared contexts `[B]`, float32.

    Attributes:
        theta_r, n, v: the contexts themselves.
        fields: the mixture, `[F, K, B]` in the order of `layout.FIELDS`; empty where only values are asked for.
        sphere: share of the uniform sphere over 4 pi, a scalar.
        need: "both", or "direct" / "scattered" where all v are 1 / 0: which half is computed.
    """

    theta_r: Tensor
    n: Tensor
    v: Tensor
    fields: Tensor
    sphere: Tensor
    need: str

    def __len__(self) -> int:
        return len(self.theta_r)

    def __getitem__(self, index: Tensor | slice) -> Contexts:
        """Some of the contexts; as many halves are computed as for all of them."""
        one = self.theta_r[index], self.n[index], self.v[index]
        return Contexts(*one, _each(self.fields, lambda x: x[..., index].contiguous()), self.sphere, self.need)

    def repeated(self, times: int) -> Contexts:
        """The contexts over and over, `[times * B]`."""
        one = (x.repeat(times) for x in (self.theta_r, self.n, self.v))
        return Contexts(*one, _each(self.fields, lambda x: x.repeat(1, 1, times)), self.sphere, self.need)


def _each(fields: Tensor, change: Callable[[Tensor], Tensor]) -> Tensor:
    """The fields changed; bare contexts have none."""
    return change(fields) if fields.ndim == 3 else fields


def need_of(v: Tensor) -> str:
    """Which half of the integrand these contexts need."""
    if not len(v):
        return "both"
    low, high = torch.aminmax(v)
    return "direct" if bool(low == 1) else "scattered" if bool(high == 0) else "both"


def mixture_fields(theta_r: Tensor, given: tuple[Tensor, ...], components: list[int]) -> Tensor:
    """`[F, K, B]` of `layout.FIELDS` for the K components among log weights, modes and widths below and above, each
    `[B, all]`.

    Each piece of a two-piece normal law is a normal law between a near and a far end. A mode that lies more than 4
    widths outside what can be reached is moved to 4 widths, with the width that keeps the logarithmic slope at the
    border: the piece is an exponential law in either case, and its tail stays within the range of float32.
    """
    log_weights, mode, below, above = (x[:, components].t() for x in given)
    log_weights = log_weights.clamp_min(-1e30)
    low, high = reachable(theta_r)
    split = torch.minimum(torch.maximum(mode, low), high)
    over, under = (mode - split).clamp_min(0), (split - mode).clamp_min(0)
    below, above = _limited(below, over), _limited(above, under)
    mode = split + torch.minimum(over, _REACH * below) - torch.minimum(under, _REACH * above)
    root = math.sqrt(0.5)
    inverse_below, inverse_above = root / below, root / above
    near_left, far_left = (_tails((mode - x) * inverse_below) for x in (split, low))
    near_right, far_right = (_tails((x - mode) * inverse_above) for x in (split, high))
    left = torch.where(split > low, below * (near_left - far_left), 0.0)
    right = torch.where(split < high, above * (near_right - far_right), 0.0)
    mass = left + right
    log_scale = log_weights - torch.log(4 * math.sqrt(math.pi / 2) * mass)
    found = {
        "mode": mode,
        "below": inverse_below,
        "above": inverse_above,
        "log_scale": log_scale,
        "edge": torch.exp(log_weights).cumsum(0),
        "left": left / mass,
        "far_left": far_left,
        "near_left": near_left,
        "far_right": far_right,
        "near_right": near_right,
    }
    return torch.stack([found[name] for name in FIELDS])


def _tails(x: Tensor) -> Tensor:
    """2 Q of sqrt(2) x; pieces that are empty may ask for x < 0."""
    return torch.erfc(x.clamp_min(0))


def _limited(width: Tensor, distance: Tensor) -> Tensor:
    """The width of a piece whose mode lies `distance` outside."""
    far = distance > _REACH * width
    return torch.where(far, _REACH * width * width / torch.where(far, distance, 1.0), width)
