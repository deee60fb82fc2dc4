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

import torch
from torch import Tensor

from dsfit.frame import TWO_PI, wrap

LOG_SQRT_2PI = 0.5 * math.log(2 * math.pi)
_MILLS_SWITCH, _MILLS_TERMS = 8.0, 14  # continued fraction: relative error < 1e-16 from 8 on with 14 terms
_SMALL_WINDOW = 0.1  # width x max(1, |middle|) below which the window is expanded about its middle


def any_of(mask: Tensor) -> bool:
    """Whether an element of `mask` is set; True under vmap, where every branch has to be computed."""
    try:
        return bool(mask.any())
    except RuntimeError:
        return True


def _all_of(mask: Tensor) -> bool:
    """Whether all elements are set; False under vmap."""
    try:
        return bool(mask.all())
    except RuntimeError:
        return False


def is_tracked(*tensors: Tensor) -> bool:
    """Whether a derivative may be asked of these tensors: in reverse or forward mode, or by `torch.func`."""
    if any(t.requires_grad for t in tensors) or torch.autograd.forward_ad._current_level >= 0:
        return True
    return torch._C._functorch.peek_interpreter_stack() is not None


def is_wrapped(tensor: Tensor) -> bool:
    """Whether the tensor belongs to a `torch.func` transform that is under way, and must not be kept beyond it."""
    return torch._C._functorch.is_functorch_wrapped_tensor(tensor)


def log_gauss(x: Tensor, std: Tensor) -> Tensor:
    """`log g(x; std) = -x^2 / (2 std^2) - log std - log sqrt(2 pi)`: chapter eqs (12), (20), (24)."""
    z = x / std
    return -0.5 * z * z - torch.log(std) - LOG_SQRT_2PI


def log_mills(a: Tensor) -> Tensor:
    """Log of the Mills ratio `M(a) = int_0^inf exp(-a t - t^2 / 2) dt`, for a >= 0.

    By erfcx below 8, by Laplace's continued fraction `1 / (a + 1 / (a + 2 / (a + ...)))` above, whose derivatives do
    not cancel.
    """
    far = a >= _MILLS_SWITCH
    result = None
    if not _all_of(far):
        near = torch.where(far, 1.0, a)
        result = torch.log(torch.special.erfcx(near * math.sqrt(0.5))) + 0.5 * math.log(math.pi / 2)
    if any_of(far):
        x = torch.where(far, a, _MILLS_SWITCH)
        fraction = x
        for k in range(_MILLS_TERMS, 0, -1):
            fraction = x + k / fraction
        tail = -torch.log(fraction)
        result = tail if result is None else torch.where(far, tail, result)
    assert result is not None
    return result


def nearest_to_zero(a: Tensor, b: Tensor) -> Tensor:
    """The point c of [a, b] nearest to 0."""
    return torch.where(a > 0, a, torch.where(b < 0, b, 0.0))


def _log_k_tail(near: Tensor, width: Tensor) -> Tensor:
    """log K of a window [near, near + width] with near >= 0 that is not small."""
    log_near = log_mills(near)
    beyond = -width * (near + 0.5 * width) + log_mills(near + width) - log_near
    return log_near + torch.log1p(-torch.exp(beyond))


def _log_k_straddling(near: Tensor, far: Tensor) -> Tensor:
    """log K of a window with near <= 0 <= far."""
    root = math.sqrt(0.5)
    return LOG_SQRT_2PI + torch.log1p(-0.5 * torch.special.erfc(-near * root) - 0.5 * torch.special.erfc(far * root))


def _log_k_small(near: Tensor, width: Tensor) -> Tensor:
    """log K of a small window, by a series about the middle (three terms, below 1e-16 relative)."""
    middle = near + 0.5 * width
    z = width * width
    p = middle * middle * z
    series = (p - z) / 24 + (p * p - 6 * p * z + 3 * z * z) / 1920
    series = series + (p * p * p - 15 * p * p * z + 45 * p * z * z - 15 * z * z * z) / 322560
    c = near.clamp_min(0)
    return torch.log(width) - 0.5 * ((near - c) + 0.5 * width) * (middle + c) + torch.log1p(series)


def log_window(a: Tensor, b: Tensor, width: Tensor | None = None) -> Tensor:
    """log K(a, b), see the module text; `width = b - a` may be given where it is known more exactly.

    Infinite ends are allowed. -inf where b <= a. Relative error of K and of its derivatives: a few 1e-16 (a few 1e-7
    in float32), from windows of 1e-300 to the whole line and from the centre to 1e6 standard deviations.
    """
    a, b = torch.broadcast_tensors(a, b)
    width = b - a if width is None else width.expand_as(a)
    left = b < 0  # mirror, so that a one-sided window always lies on the right
    near, far = torch.where(left, -b, a), torch.where(left, -a, b)
    big = torch.finfo(a.dtype).max ** 0.25
    valid = width > 0
    small = valid & (width * (0.5 * (near + far)).abs().clamp_min(1) < _SMALL_WINDOW)
    tail = valid & (near > 0) & ~small
    straddling = valid & (near <= 0) & ~small
    result = torch.full_like(a, -math.inf)
    if any_of(straddling):
        value = _log_k_straddling(torch.where(straddling, near, -1.0), torch.where(straddling, far, 1.0))
        result = torch.where(straddling, value, result)
    if any_of(tail):
        value = _log_k_tail(torch.where(tail, near, 1.0), torch.where(tail, width, 1.0).clamp_max(big))
        result = torch.where(tail, value, result)
    if any_of(small):
        value = _log_k_small(torch.where(small, near, 0.0), torch.where(small, width, 0.01))
        result = torch.where(small, value, result)
    return result


def log_normal_mass(a: Tensor, b: Tensor) -> Tensor:
    """`log(Phi(b) - Phi(a))`, stable everywhere (FORMULAS section E); -inf where b <= a; infinite ends are allowed."""
    a, b = torch.broadcast_tensors(a, b)
    c = nearest_to_zero(a, b)
    return log_window(a, b) - 0.5 * c * c - LOG_SQRT_2PI


def truncated_normal_log_prob(x: Tensor, mean: Tensor, std: Tensor, low: Tensor, high: Tensor) -> Tensor:
    """Log density at x of the normal law truncated to [low, high], per unit of x; -inf outside, with zero gradient.

    `-(x - r)(x + r - 2 mean) / (2 std^2) - log std - log K`, r = the point of [low, high] nearest to the mean: no
    term is larger than the result needs it to be, however far the window is from the mean. FORMULAS section E.
    """
    a, b = (low - mean) / std, (high - mean) / std
    reference = torch.where(a > 0, low, torch.where(b < 0, high, mean))
    inside = (x >= low) & (x <= high)
    safe = torch.where(inside, x, reference.detach())
    log_norm = torch.log(std) + log_window(a, b, (high - low) / std)
    value = -0.5 * ((safe - reference) / std) * ((safe + reference - 2 * mean) / std) - log_norm
    return torch.where(inside, value, -math.inf)


def truncated_normal_icdf(u: Tensor, mean: Tensor, std: Tensor, low: Tensor, high: Tensor) -> Tensor:
    """Inverse CDF at u in (0, 1) of the normal law truncated to [low, high]; the result lies in [low, high].

    The root is found without tracking derivatives; one Newton step on `F(z; a, b) = u`, whose value is zero, carries
    those of all five arguments, in forward and in reverse mode:

        phi(z) dz = (1 - u) phi(a) da + u phi(b) db + (Phi(b) - Phi(a)) du,   x = mean + std z.

    First derivatives only: second derivatives of this function come out as zero. u is clamped into the open interval.
        FORMULAS section E has the forms.
    """
    eps, tiny = torch.finfo(u.dtype).eps, torch.finfo(u.dtype).tiny
    a, b, width = (low - mean) / std, (high - mean) / std, (high - low) / std
    with torch.no_grad():
        p = u.detach().clamp(tiny, 1 - eps / 2)
        a0, b0, width0 = torch.broadcast_tensors(a.detach(), b.detach(), width.detach())
        c0 = nearest_to_zero(a0, b0)
        offset = _standard_offset(p, a0, b0, width0)
        reference = torch.where(a0 > 0, low.detach(), torch.where(b0 < 0, high.detach(), mean.detach()))
        x = reference + std.detach() * offset
        x = torch.minimum(torch.maximum(x, low.detach()), high.detach())
    if not is_tracked(u, mean, std, low, high):
        return x
    with torch.no_grad():
        from_a = torch.where(a0 > 0, 0.0, torch.where(b0 < 0, width0, -a0))  # c - a and c - b without cancellation
        from_b = torch.where(b0 < 0, 0.0, torch.where(a0 > 0, -width0, -b0))
        along_a = torch.exp(torch.log1p(-p) + 0.5 * (offset + from_a) * (offset + (c0 + a0)))
        along_b = torch.exp(torch.log(p) + 0.5 * (offset + from_b) * (offset + (c0 + b0)))
        along_u = torch.exp(log_window(a0, b0, width0) + 0.5 * offset * (offset + 2 * c0))
    step = along_a * (a - a0) + along_b * (b - b0) + along_u * (u - u.detach())
    carrier = mean + std * ((c0 + offset) + step)
    return x + (carrier - carrier.detach())


def _standard_offset(p: Tensor, a: Tensor, b: Tensor, width: Tensor) -> Tensor:
    """z - c for the standard normal truncated to [a, b] at probability p; c = the point nearest to 0. No derivatives.

    The window is mirrored so that it, or its heavier half, lies on the right. Conditions have the shape of a and b
    alone.
    """
    flip = a + b < 0
    low, high = torch.where(flip, -b, a), torch.where(flip, -a, b)
    p, q = torch.where(flip, 1 - p, p), torch.where(flip, p, 1 - p)
    small = width * high.clamp_min(1) < _SMALL_WINDOW
    far = (low > (25.0 if p.dtype == torch.float64 else 8.0)) & ~small
    central = ~small & ~far
    result = torch.zeros_like(p)
    if any_of(central):
        result = _offset_central(p, q, torch.where(central, low, -1.0), torch.where(central, high, 1.0))
    if any_of(far):
        value = _offset_far(p, q, torch.where(far, low, 30.0), torch.where(far, width, 1.0))
        result = torch.where(far, value, result)
    if any_of(small):
        value = _offset_small(p, torch.where(small, low, 0.0), torch.where(small, width, 0.01))
        result = torch.where(small, value, result)
    return torch.where(flip, -result, result)


def _offset_central(p: Tensor, q: Tensor, low: Tensor, high: Tensor) -> Tensor:
    """By ndtri of the smaller of the two tail probabilities, each a sum of positive terms."""
    root = math.sqrt(0.5)
    above = q * (0.5 * torch.special.erfc(low * root)) + p * (0.5 * torch.special.erfc(high * root))
    below = q * (0.5 * torch.special.erfc(-low * root)) + p * (0.5 * torch.special.erfc(-high * root))
    z = torch.special.ndtri(torch.minimum(above, below))
    z = torch.where(above < below, -z, z)
    return torch.minimum(torch.maximum(z, low), high) - low.clamp_min(0)


def _offset_far(p: Tensor, q: Tensor, low: Tensor, width: Tensor) -> Tensor:
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


def _offset_small(p: Tensor, low: Tensor, width: Tensor) -> Tensor:
    """By the exponential law of the slope at the middle and three Newton steps on the log CDF."""
    slope = (low + 0.5 * width) * width
    flat = slope.abs() < 1e-30
    s = torch.where(flat, 1.0, slope)
    fraction = torch.where(flat, p, -torch.log1p(p * torch.expm1(-s)) / s)
    whole, log_p = _log_k_small(low, width), torch.log(p)
    c = low.clamp_min(0)
    for _ in range(3):
        t = (fraction * width).clamp_min(torch.finfo(p.dtype).tiny)
        part, z = _log_k_small(low, t), low + t
        step = (part - whole - log_p) * torch.exp(part + 0.5 * (z - c) * (z + c)) / width
        fraction = (fraction - step).clamp(0, 1)
    return fraction * width + (low - c)


def wrapped_normal_log_prob(x: Tensor, std: Tensor) -> Tensor:
    """Log density per radian at angle x of a centred normal of standard deviation `std` wrapped around the circle.

    Two regimes (FORMULAS E2): images `x + 2 pi k` summed relative to the nearest for std <= 2, Fourier series above.
    Source: chapter eqs (21), (24), corrected.
    """
    x, wide = wrap(x), std > 2
    result = None
    if not _all_of(wide):
        s = std.clamp_max(2.0)
        rate = TWO_PI / (s * s)
        images = 0.0
        for k in range(1, 2 if not any_of(std > 1) else 4):
            shift = math.pi * k
            images = images + torch.exp(-rate * k * (shift + x)) + torch.exp(-rate * k * (shift - x))
        result = log_gauss(x, s) + torch.log1p(images)
    if any_of(wide):
        s = std.clamp_min(2.0)
        waves = sum(torch.exp(-0.5 * (k * s) ** 2) * torch.cos(k * x) for k in range(1, 5))
        value = torch.log1p(2 * waves) - math.log(TWO_PI)
        result = value if result is None else torch.where(wide, value, result)
    assert result is not None
    return result
