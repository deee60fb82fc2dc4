"""Compares one value of a new run with its reference, by each kind of rule."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from dsfit.figures.rules import Close, Estimate


@dataclass(frozen=True)
class Found:
    """How a value agrees.

    Attributes:
        count: numbers compared.
        deviation: the largest, in units of what the rule allows: 1 is the limit. nan where there is no such unit.
        what: the worst in words, empty if nothing is to tell.
        agrees: whether all of it is within the rule.
    """

    count: int
    deviation: float
    what: str
    agrees: bool


def exact(new: Any, old: Any) -> Found:
    """Equal: arrays in type, shape and every bit, so that nan equals the same nan."""
    if isinstance(new, np.ndarray) and isinstance(old, np.ndarray):
        if (reason := _unlike(new, old)) or new.dtype != old.dtype:
            return _failed(old, reason or f"type {new.dtype}, not {old.dtype}")
        same = new == old if new.dtype.kind in "USbO" else _bits(new) == _bits(old)
        return _told(~np.asarray(same), new, old)
    same = type(new) is type(old) and new == old
    return Found(_count(old), 0.0 if same else math.inf, "" if same else f"{_short(new)}, not {_short(old)}", same)


def close(new: Any, old: Any, rule: Close) -> Found:
    """|new - old| <= atol + rtol |old|; what is not finite must be so in both, in the same places. Words must be
    equal."""
    a, b = numbers(new), numbers(old)
    if a is None or b is None:
        return exact(new, old)
    if reason := _unlike(a, b):
        return _failed(b, reason)
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        difference, allowed = np.abs(a - b), rule.atol + rule.rtol * np.abs(b)
        share = np.where(difference == 0, 0.0, difference / allowed)
    share = np.where(_same_infinite(a, b), 0.0, np.where(np.isfinite(a) & np.isfinite(b), share, np.inf))
    return _worst(share, lambda k: f"{_short(a[k])} for {_short(b[k])}, {_short(share[k])} times what is allowed")


def estimate(new: Any, old: Any, errors: tuple[Any, Any], rule: Estimate, bound: float) -> Found:
    """z = (new - old) / sqrt(s_new^2 + s_old^2) within the bound, and standard errors within `most` of the reference.

    A value that is not finite must be so in both, in the same places. Without any standard error values must be equal.
    """
    a, b = numbers(new), numbers(old)
    s = [numbers(error) for error in errors]
    if a is None or b is None or s[0] is None or s[1] is None:
        return _failed(old, "no numbers, or no standard errors for them")
    if reason := _unlike(a, b):
        return _failed(b, reason)
    try:
        s_new, s_old = (np.broadcast_to(one, b.shape) for one in s)
    except ValueError:
        return _failed(b, f"standard errors of shape {s[0].shape} and {s[1].shape}")
    known = np.isfinite(s_new) & np.isfinite(s_old) & (s_new >= 0) & (s_old >= 0)
    finite, same = np.isfinite(a) & np.isfinite(b), _same_infinite(a, b)
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        z = np.where(a == b, 0.0, (a - b) / np.hypot(s_new, s_old))
        loose = np.maximum(s_new, s_old) > rule.most * np.abs(b)
    z = np.where(finite & known, np.abs(z), np.inf)
    z = np.where(same, 0.0, z)
    loose = loose & ~same & known
    found = _worst(z / bound, lambda k: _of_estimate(a[k], b[k], z[k], bound))
    if found.agrees and loose.any():
        k = _first(loose)
        what = f"too little data: {_short(b[k])} with standard error {_short(max(s_new[k], s_old[k]))}{_at(k)}"
        return Found(found.count, math.inf, what, False)
    return found


def standard_error(new: Any, old: Any) -> Found:
    """Of standard errors themselves: there, of the same shape, finite where the reference is."""
    a, b = numbers(new), numbers(old)
    if a is None or b is None:
        return exact(new, old)
    if reason := _unlike(a, b):
        return _failed(b, reason)
    wrong = (np.isfinite(b) != np.isfinite(a)) | (a < 0)
    return _told(wrong, a, b)


def measured(new: Any, old: Any) -> Found:
    """The range of ratios is told; nothing is held to it but the shape."""
    a, b = numbers(new), numbers(old)
    if a is None or b is None:
        return Found(_count(old), math.nan, "", True)
    if reason := _unlike(a, b):
        return Found(b.size, math.nan, reason, True)
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        ratio = (a / b)[np.isfinite(a) & np.isfinite(b) & (b != 0)]
    if not ratio.size:
        return Found(b.size, math.nan, "", True)
    low, high = float(ratio.min()), float(ratio.max())
    return Found(b.size, math.nan, f"{_short(low)}" + (f" to {_short(high)}" if high > low else "") + " times", True)


def numbers(value: Any) -> np.ndarray | None:
    """A value of an array or a record as floats, with "nan", "inf" and "-inf" as JSON keeps them; None if it holds
    anything else."""
    if isinstance(value, np.ndarray):
        return value.astype(np.complex128 if value.dtype.kind == "c" else np.float64) if value.dtype.kind in (
            "iufc"
        ) else None  # fmt: skip
    items = value if isinstance(value, list) else [value]
    if not all(isinstance(x, int | float) and not isinstance(x, bool) or x in ("nan", "inf", "-inf") for x in items):
        return None
    found = np.array([float(x) for x in items], dtype=np.float64)
    return found if isinstance(value, list) else found.reshape(())


def _unlike(new: np.ndarray, old: np.ndarray) -> str:
    return "" if new.shape == old.shape else f"shape {new.shape}, not {old.shape}"


def _bits(values: np.ndarray) -> np.ndarray:
    """Values as they are stored, so that nan compares and -0 differs from 0."""
    width = values.dtype.itemsize
    plain = np.ascontiguousarray(values)
    return plain.view(f"V{width}") if width not in (1, 2, 4, 8) else plain.view(f"u{width}")


def _same_infinite(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Where both are nan, or the same infinity."""
    return (np.isnan(a) & np.isnan(b)) | (~np.isfinite(b) & (a == b))


def _told(wrong: np.ndarray, new: np.ndarray, old: np.ndarray) -> Found:
    if not wrong.any():
        return Found(old.size, 0.0, "", True)
    k = _first(wrong)
    return Found(old.size, math.inf, f"{int(wrong.sum())} differ, {_short(new[k])} for {_short(old[k])}{_at(k)}", False)


def _worst(share: np.ndarray, words: Any) -> Found:
    if not share.size:
        return Found(0, 0.0, "", True)
    k = tuple(int(i) for i in np.unravel_index(np.argmax(share), share.shape))
    worst = float(share[k])
    return Found(share.size, worst, f"{words(k)}{_at(k)}" if worst > 0 else "", worst <= 1)


def _of_estimate(new: Any, old: Any, z: float, bound: float) -> str:
    return f"{_short(new)} for {_short(old)}, z {z:.2f} of {bound:.2f} allowed"


def _failed(old: Any, what: str) -> Found:
    return Found(_count(old), math.inf, what, False)


def _count(value: Any) -> int:
    return value.size if isinstance(value, np.ndarray) else len(value) if isinstance(value, list) else 1


def _first(wrong: np.ndarray) -> tuple[int, ...]:
    return tuple(int(i) for i in np.argwhere(wrong)[0])


def _at(k: tuple[int, ...]) -> str:
    return f" at {', '.join(map(str, k))}" if k else ""


def _short(value: Any) -> str:
    if isinstance(value, float | np.floating):
        return f"{float(value):.6g}"
    text = str(value)
    return text if len(text) <= 40 else text[:37] + "..."
