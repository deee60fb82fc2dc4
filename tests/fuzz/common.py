"""What the fuzz tests share: settings, strange numbers, and the one rule that every entry point is held to.

The examples are the same in every run (`derandomize`). `DSFIT_FUZZ=50 python -m pytest tests/fuzz` tries fifty times as
many, `DSFIT_FUZZ_RANDOM=1` others in each run.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from torch import Tensor

from dsfit.errors import InputError

SCALE = float(os.environ.get("DSFIT_FUZZ", "1"))
RANDOM = bool(os.environ.get("DSFIT_FUZZ_RANDOM"))


def fuzz(examples: int) -> settings:
    """Settings with `examples` examples by default."""
    return settings(
        max_examples=max(1, round(examples * SCALE)),
        deadline=None,
        derandomize=not RANDOM,
        database=None,
        suppress_health_check=list(HealthCheck),
        print_blob=False,
    )


_NASTY = [
    *(0.0, -0.0, 1.0, -1.0, 0.5, 2.0, float("nan"), float("inf"), -float("inf")),
    *(5e-324, -5e-324, 1e-310, 2.2e-308, 1e-45, 1e-38, 1e-16, -1e-16, 1e-300, 1e300, -1e300, 1.7e308, 3.4e38, 1e39),
    *(1.5707963267948966, 1.5707963267948968, -1.5707963267948966, 1.5707964, 3.141592653589793, 6.283185307179586),
    *(0.7071067811865475, 0.7071067811865476, 1.4142135623730951, 1 - 2**-53, 1 + 2**-52, 1e-5, 1e-4, 1e2, 1e6, 1e9),
]
numbers = st.sampled_from(_NASTY) | st.floats() | st.floats(-4, 4)
"""Floats of every kind: ends of ranges, one ulp off them, subnormal, huge, not finite, and ordinary ones."""

tame = st.sampled_from([x for x in _NASTY if abs(x) < 10]) | st.floats(-4, 4)
"""Mostly acceptable floats."""

unit = st.sampled_from([0.0, 1.0, 0.5, 1e-300, 2**-53, 1 - 2**-53, 1e-17]) | st.floats(0, 1)
"""Floats in [0, 1]."""

_DTYPES = [torch.float64] * 4 + [torch.float32] * 2
_DTYPES += [torch.float16, torch.bfloat16, torch.int64, torch.uint8, torch.bool, torch.complex64, torch.complex128]
_SHAPES: list[tuple[int, ...]] = [(), (), (1,), (2,), (3,), (3,), (0,), (2, 3), (3, 1), (1, 3), (2, 2), (0, 3)]
_SHAPES += [(2, 1, 3)]


@st.composite
def tensors(draw: st.DrawFn, elements: st.SearchStrategy[float] = numbers) -> Tensor:
    """Tensors of small shapes (some empty) and of every dtype."""
    shape, dtype = draw(st.sampled_from(_SHAPES)), draw(st.sampled_from(_DTYPES))
    count = int(torch.Size(shape).numel())
    values = draw(st.lists(elements, min_size=count, max_size=count))
    if not dtype.is_floating_point and not dtype.is_complex:
        values = [int(x) % 3 if abs(x) < 1e9 else 1 for x in (0.0 if x != x else x for x in values)]
    return torch.tensor(values, dtype=torch.float64).to(dtype).reshape(shape)


others = st.sampled_from([None, True, "x", "", b"x", [], [[]], {}, (), object(), 1j, 10**400, [1, [2]], ["a"], [None]])
"""Things that are no numbers."""

anything = numbers | st.integers(-3, 3) | tensors() | st.lists(numbers, max_size=4) | others
"""Anything that may be given where a number or a tensor is expected."""

mostly_fine = tame | st.integers(0, 3) | st.lists(tame, min_size=1, max_size=3) | tensors(tame)


def attempt(function: Callable[..., Any], *args: Any, **kwargs: Any) -> Any:
    """What the function returns, or the `InputError` it raises; every other exception is a failed test."""
    try:
        return function(*args, **kwargs)
    except InputError as error:
        text = str(error)
        assert error.field and "allowed: " in text and "got " in text, text
        assert len(text) < 5000, text[:500]
        return error


def refused(result: Any) -> bool:
    """Whether `attempt` met an `InputError`."""
    return isinstance(result, InputError)


def finite(*values: Tensor) -> None:
    """Every element is finite."""
    for value in values:
        assert isinstance(value, Tensor)
        assert bool(torch.isfinite(value).all()), value


def listing(folder: Path) -> dict[str, bytes | None]:
    """Every file and folder below, with what is in the files."""
    return {str(p.relative_to(folder)): p.read_bytes() if p.is_file() else None for p in sorted(folder.rglob("*"))}
