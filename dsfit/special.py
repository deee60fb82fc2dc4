"""Log densities and inverse CDFs of truncated and wrapped normal laws, stable everywhere and differentiable.

All functions take tensors of any broadcastable shapes, keep dtype (float64 and float32) and device, and work in
reverse and forward mode, under `torch.func.jacfwd`, `jacrev` and `vmap`. Masks act on inputs, so no branch that is
not taken can put a NaN into a gradient. A branch is skipped when no element needs it.

Everything rests on one integral that neither under- nor overflows,

    K(a, b) = int_a^b exp(-(z^2 - c^2) / 2) dz,    c = the point of [a, b] nearest to 0,

so that `Phi(b) - Phi(a) = K exp(-c^2 / 2) / sqrt(2 pi)`, and on the Mills ratio `M(a) = K(a, inf)`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from dsfit.frame import TWO_PI, wrap

LOG_SQRT_2PI = 0.5 * math.log(2 * math.pi)
_ROOT_HALF = math.sqrt(0.5)
_MILLS_SWITCH, _MILLS_TERMS = 8.0, 14  # continued fraction: relative error < 1e-16 from 8 on with 14 terms
_SMALL_WINDOW = 0.1  # width x max(1, |middle|) below which the window is expanded about its middle

Branch = tuple[Tensor, Callable[..., Tensor], tuple[float, ...]]
"""Mask, function, and arguments at which the function is smooth."""


def any_of(mask: Tensor) -> bool:
    """Whether an element of `mask` is set; True under vmap, where every branch has to be computed."""
    try:
        return bool(mask.any())
    except RuntimeError:
        return True


def is_tracked(*tensors: Tensor) -> bool:
    """Whether a derivative may be asked of these tensors: in reverse or forward mode, or by `torch.func`."""
    if any(t.requires_grad for t in tensors) or torch.autograd.forward_ad._current_level >= 0:
        return True
    return torch._C._functorch.peek_interpreter_stack() is not None


def is_differentiated(tensor: Tensor) -> bool:
    """Whether a derivative in this tensor is being asked for: `requires_grad`, or a tangent of forward mode."""
    return tensor.requires_grad or torch.autograd.forward_ad.unpack_dual(tensor).tangent is not None


def is_wrapped(tensor: Tensor) -> bool:
    """Whether the tensor belongs to a `torch.func` transform that is under way, and must not be kept beyond it."""
    return torch._C._functorch.is_functorch_wrapped_tensor(tensor)


def piecewise(branches: Sequence[Branch], *args: Tensor, base: Tensor | None = None) -> Tensor:
    """A function given by branches with disjoint masks, over a base where no mask is set.

    Each function sees only the elements of its branch, so the others cost nothing and cannot spoil a gradient. Under
    vmap, where sizes cannot depend on data, it sees all, with its smooth arguments put in the place of the others.
    Masks broadcast to the arguments. Without a base the masks must cover everything.
    """
    try:
        present = [branch for branch in branches if bool(branch[0].any())]
        if base is None and len(present) == 1:
            return present[0][1](*args)
        if not present:
            return branches[0][1](*args) if base is None else base  # without a base, there are no elements
        *args, _ = torch.broadcast_tensors(*args, present[0][0])
        flat, shape = [arg.reshape(-1) for arg in args], args[0].shape
        result = torch.zeros_like(flat[0]) if base is None else base.expand(shape).reshape(-1)
        for mask, function, _ in present:
            index = torch.nonzero(mask.expand(shape).reshape(-1))[:, 0]
            result = result.index_put((index,), function(*(arg[index] for arg in flat)))
        return result.reshape(shape)
    except RuntimeError:
        result = base
        for mask, function, safe in branches:
            value = function(*(torch.where(mask, arg, x) for arg, x in zip(args, safe, strict=True)))
            result = value if result is None else torch.where(mask, value, result)
        return result


def log_gauss(x: Tensor, std: Tensor) -> Tensor:
    """`log g(x; std) = -x^2 / (2 std^2) - log std - log sqrt(2 pi)`: chapter eqs (12), (20), (24)."""
    z = x / std
    return -0.5 * z * z - torch.log(std) - LOG_SQRT_2PI


def _log_mills_near(a: Tensor) -> Tensor:
    return torch.log(torch.special.erfcx(a * _ROOT_HALF)) + 0.5 * math.log(math.pi / 2)


def _log_mills_far(a: Tensor) -> Tensor:
    fraction = a
    for k in range(_MILLS_TERMS, 0, -1):
        fraction = a + k / fraction
    return -torch.log(fraction)


def log_mills(a: Tensor) -> Tensor:
    """Log of the Mills ratio `M(a) = int_0^inf exp(-a t - t^2 / 2) dt`, for a >= 0.

    By erfcx below 8, by Laplace's continued fraction `1 / (a + 1 / (a + 2 / (a + ...)))` above, whose derivatives do
    not cancel.
    """
    far = a >= _MILLS_SWITCH
    return piecewise([(~far, _log_mills_near, (1.0,)), (far, _log_mills_far, (_MILLS_SWITCH,))], a)


def nearest_to_zero(a: Tensor, b: Tensor) -> Tensor:
    """The point c of [a, b] nearest to 0."""
    return a.clamp_min(0) + b.clamp_max(0)


def _log_k_tail(near: Tensor, far: Tensor, width: Tensor) -> Tensor:
    """log K of a window [near, near + width] with near >= 0 that is not small."""
    log_near = log_mills(near)
    width = width.clamp_max(torch.finfo(width.dtype).max ** 0.25)  # an infinite end
    beyond = -width * (near + 0.5 * width) + log_mills(near + width) - log_near
    return log_near + torch.log1p(-torch.exp(beyond))


def _log_k_straddling(near: Tensor, far: Tensor) -> Tensor:
    """log K of a window with near <= 0 <= far."""
    outside = torch.special.erfc(-near * _ROOT_HALF) + torch.special.erfc(far * _ROOT_HALF)
    return LOG_SQRT_2PI + torch.log1p(-0.5 * outside)


def _log_k_small(near: Tensor, far: Tensor, width: Tensor) -> Tensor:
    """log K of a small window, by a series about the middle (three terms, below 1e-16 relative)."""
    middle = near + 0.5 * width
    z = width * width
    p = middle * middle * z
    series = (p - z) / 24 + (p * p - 6 * p * z + 3 * z * z) / 1920
    series = series + (p * p * p - 15 * p * p * z + 45 * p * z * z - 15 * z * z * z) / 322560
    c = near.clamp_min(0)
    return torch.log(width) - 0.5 * ((near - c) + 0.5 * width) * (middle + c) + torch.log1p(series)


def _log_k_empty(near: Tensor, far: Tensor, width: Tensor) -> Tensor:
    return torch.full_like(near, -math.inf)


def log_window(a: Tensor, b: Tensor, width: Tensor | None = None) -> Tensor:
    """log K(a, b), see the module text; `width = b - a` may be given where it is known more exactly.

    Infinite ends are allowed. -inf where b <= a. Relative error of K and of its derivatives: a few 1e-16 (a few 1e-7 in
    float32), from windows of 1e-300 to the whole line and from the centre to 1e6 standard deviations.
    """
    width = b - a if width is None else width
    near, far = torch.maximum(a, -b), torch.maximum(b, -a)  # mirrored: a one-sided window lies on the right
    empty = ~(width > 0)
    small = (width * (0.5 * (near + far)).clamp_min(1) < _SMALL_WINDOW) & ~empty
    tail = (near > 0) & ~small & ~empty
    # Most windows straddle 0; the clamps change none of those, and keep the others away from log 0.
    straddling = _log_k_straddling(near.clamp_max(0), far.clamp_min(0.5 * _SMALL_WINDOW))
    branches: list[Branch] = [
        (tail, _log_k_tail, (1.0, 2.0, 1.0)),
        (small, _log_k_small, (0.0, 0.01, 0.01)),
        (empty, _log_k_empty, (0.0, 0.0, 0.0)),
    ]
    return piecewise(branches, near, far, width, base=straddling)


def log_normal_mass(a: Tensor, b: Tensor) -> Tensor:
    """`log(Phi(b) - Phi(a))`, stable everywhere; -inf where b <= a; infinite ends are allowed."""
    c = nearest_to_zero(a, b)
    return log_window(a, b) - 0.5 * c * c - LOG_SQRT_2PI


def normal_mass(a: Tensor, b: Tensor) -> Tensor:
    """`Phi(b) - Phi(a)` for a <= b, from the smaller tails by erfc, so that float32 keeps its digits in the tails too.

    `torch.special.ndtr` returns 0 in float32 from 5.5 standard deviations on.
    """
    flip = a > 0
    low, high = torch.where(flip, -b, a), torch.where(flip, -a, b)
    return 0.5 * (torch.special.erfc(-high * _ROOT_HALF) - torch.special.erfc(-low * _ROOT_HALF))


def truncated_normal_log_density(x: Tensor, mean: Tensor, std: Tensor, low: Tensor, high: Tensor) -> Tensor:
    """`truncated_normal_log_prob` for x known to be in [low, high]."""
    reference = torch.minimum(torch.maximum(mean, low), high)
    log_norm = torch.log(std) + log_window((low - mean) / std, (high - mean) / std, (high - low) / std)
    # Few operations that involve x: it is the only tensor of the size of the samples.
    return (x - reference) * ((x + (reference - 2 * mean)) * (-0.5 / (std * std))) - log_norm


def truncated_normal_log_prob(x: Tensor, mean: Tensor, std: Tensor, low: Tensor, high: Tensor) -> Tensor:
    """Log density at x of the normal law truncated to [low, high], per unit of x; -inf outside, with zero gradient.

    `-(x - r)(x + r - 2 mean) / (2 std^2) - log std - log K`, r = the point of [low, high] nearest to the mean: no term
    is larger than the result needs it to be, however far the window is from the mean.
    """
    outside = (x < low) | (x > high)
    inner = torch.where(outside, torch.minimum(torch.maximum(mean, low), high).detach(), x)
    return truncated_normal_log_density(inner, mean, std, low, high).masked_fill(outside, -math.inf)


def truncated_normal_icdf(u: Tensor, mean: Tensor, std: Tensor, low: Tensor, high: Tensor) -> Tensor:
    """Inverse CDF at u in (0, 1) of the normal law truncated to [low, high]; the result lies in [low, high].

    The root is found without tracking derivatives; one Newton step on `F(z; a, b) = u`, whose value is zero, carries
    those of all five arguments, in forward and in reverse mode:

        phi(z) dz = (1 - u) phi(a) da + u phi(b) db + (Phi(b) - Phi(a)) du,   x = mean + std z.

    First derivatives only: second derivatives of this function come out as zero, and those of what is made of it are
    wrong. u is clamped into the open interval.
    """
    a, b, width = (low - mean) / std, (high - mean) / std, (high - low) / std
    with torch.no_grad():
        p = u.detach().clamp(torch.finfo(u.dtype).tiny, 1 - torch.finfo(u.dtype).eps / 2)
        a0, b0, width0, low0, high0 = (t.detach() for t in (a, b, width, low, high))
        offset = _standard_offset(p, a0, b0, width0)
        x = torch.minimum(torch.maximum(mean.detach(), low0), high0) + std.detach() * offset
        x = torch.minimum(torch.maximum(x, low0), high0)
    if not is_tracked(u, mean, std, low, high):
        return x
    with torch.no_grad():
        c0 = nearest_to_zero(a0, b0)
        from_a = torch.minimum((-a0).clamp_min(0), width0)  # c - a, without cancellation
        from_b = -torch.minimum(b0.clamp_min(0), width0)  # c - b
        along_a = torch.exp(torch.log1p(-p) + 0.5 * (offset + from_a) * (offset + (c0 + a0)))
        along_b = torch.exp(torch.log(p) + 0.5 * (offset + from_b) * (offset + (c0 + b0)))
        along_u = torch.exp(log_window(a0, b0, width0) + 0.5 * offset * (offset + 2 * c0))
    step = along_a * (a - a0) + along_b * (b - b0) + along_u * (u - u.detach())
    carrier = mean + std * ((c0 + offset) + step)
    return x + (carrier - carrier.detach())


def _standard_offset(p: Tensor, a: Tensor, b: Tensor, width: Tensor) -> Tensor:
    """z - c for the standard normal truncated to [a, b] at probability p; c = the point nearest to 0. No derivatives.

    The window is mirrored so that it, or its heavier half, lies on the right.
    """
    mirror = (a + b < 0).to(p.dtype)
    low, high = torch.maximum(a, -b), torch.maximum(b, -a)
    p, q = (mirror - p).abs(), (1 - mirror - p).abs()  # p and 1 - p, exchanged where mirrored
    small = width * high.clamp_min(1) < _SMALL_WINDOW
    far = (low > (25.0 if p.dtype == torch.float64 else 8.0)) & ~small
    branches: list[Branch] = [
        (far, _offset_far, (0.5, 0.5, 30.0, 31.0, 1.0)),
        (small, _offset_small, (0.5, 0.5, 0.0, 0.01, 0.01)),
    ]
    central = _offset_central(p, q, low, high)  # right for most; whatever it gives elsewhere is overwritten
    return (1 - 2 * mirror) * piecewise(branches, p, q, low, high, width, base=central)


def _offset_central(p: Tensor, q: Tensor, low: Tensor, high: Tensor) -> Tensor:
    """By ndtri of the smaller of the two tail probabilities, each a sum of positive terms."""
    x, y = low * _ROOT_HALF, high * _ROOT_HALF
    above = q * (0.5 * torch.special.erfc(x)) + p * (0.5 * torch.special.erfc(y))
    below = q * (0.5 * torch.special.erfc(-x)) + p * (0.5 * torch.special.erfc(-y))
    z = torch.copysign(torch.special.ndtri(torch.minimum(above, below)), below - above)
    return torch.minimum(torch.maximum(z, low), high) - low.clamp_min(0)


def _offset_far(p: Tensor, q: Tensor, low: Tensor, high: Tensor, width: Tensor) -> Tensor:
    """By the Rayleigh tail and three Newton steps on log of the survival function relative to that at `low`."""
    width = width.clamp_max(torch.finfo(p.dtype).max ** 0.25)
    log_low = log_mills(low)
    left = -width * (low + 0.5 * width) + log_mills(low + width) - log_low  # log survival at the upper end
    y = -torch.where(p < 0.5, torch.log1p(p * torch.expm1(left)), torch.log(q + p * torch.exp(left)))
    t = 2 * y / (low + torch.sqrt(low * low + 2 * y))
    for _ in range(3):
        log_t = log_mills(low + t)
        t = t - (t * (low + 0.5 * t) - (log_t - log_low) - y) * torch.exp(log_t)
        t = torch.minimum(t.clamp_min(0), width)
    return t


def _offset_small(p: Tensor, q: Tensor, low: Tensor, high: Tensor, width: Tensor) -> Tensor:
    """By the exponential law of the slope at the middle and three Newton steps on the log CDF."""
    slope = (low + 0.5 * width) * width
    flat = slope.abs() < 1e-30
    s = torch.where(flat, 1.0, slope)
    fraction = torch.where(flat, p, -torch.log1p(p * torch.expm1(-s)) / s)
    whole, log_p = _log_k_small(low, high, width), torch.log(p)
    c = low.clamp_min(0)
    for _ in range(3):
        t = (fraction * width).clamp_min(torch.finfo(p.dtype).tiny)
        z = low + t
        part = _log_k_small(low, z, t)
        step = (part - whole - log_p) * torch.exp(part + 0.5 * (z - c) * (z + c)) / width
        fraction = (fraction - step).clamp(0, 1)
    return fraction * width + (low - c)


def wrapped_normal_log_prob(x: Tensor, std: Tensor) -> Tensor:
    """Log density per radian at angle x of a centred normal of standard deviation `std` wrapped around the circle.

    Two regimes: images `x + 2 pi k` summed relative to the nearest for std <= 2, Fourier series above.
    Source: chapter eqs (21), (24), corrected.
    """
    x, wide = wrap(x), std > 2
    branches: list[Branch] = [(~wide, _wrapped_images, (0.0, 1.0)), (wide, _wrapped_waves, (0.0, 3.0))]
    return piecewise(branches, x, std)


def _wrapped_images(x: Tensor, std: Tensor) -> Tensor:
    rate = TWO_PI / (std * std)
    images = torch.exp(-rate * (math.pi + x)) + torch.exp(-rate * (math.pi - x))
    if any_of(std > 1):
        for k in (2, 3):
            images = images + torch.exp(-rate * k * (math.pi * k + x)) + torch.exp(-rate * k * (math.pi * k - x))
    return log_gauss(x, std) + torch.log1p(images)


def _wrapped_waves(x: Tensor, std: Tensor) -> Tensor:
    waves = torch.exp(-0.5 * std * std) * torch.cos(x)
    for k in (2, 3, 4):
        waves = waves + torch.exp(-0.5 * (k * std) ** 2) * torch.cos(k * x)
    return torch.log1p(2 * waves) - math.log(TWO_PI)


def log_share(share: Tensor) -> Tensor:
    """log of a share in [0, 1], -inf (with zero gradient) where it is 0."""
    zero = share <= 0
    return torch.log(torch.where(zero, 1.0, share)).masked_fill(zero, -math.inf)
