"""Contexts that are met once: prepared, drawn from and evaluated in one pass of compiled code."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from dsfit.errors import InputError
from dsfit.kernels.layout import NEEDS

if TYPE_CHECKING:
    from dsfit.kernels.hair import HairKernel


def are_plain(*given: object) -> bool:
    """Whether all are contiguous float32 tensors `[B]` that compiled code can read as they are."""
    for x in given:
        if not (isinstance(x, Tensor) and x.dtype is torch.float32 and x.ndim == 1 and x.is_cpu and x.is_contiguous()):
            return False
    return all(x.shape == given[0].shape for x in given)


def check_uniforms(u: Tensor, batch: int) -> None:
    """Raise `InputError` unless `u` is float32 `[S, batch, 3]` and holds at least one triple."""
    if not isinstance(u, Tensor) or u.dtype != torch.float32:
        raise InputError("u", getattr(u, "dtype", type(u).__name__), "a torch.float32 tensor")
    if u.ndim != 3 or u.shape[1:] != (batch, 3) or not u.numel():
        raise InputError("u", tuple(u.shape), f"shape [S, {batch}, 3] with at least one triple")


def shade(kernel: HairKernel, context: tuple[Tensor, Tensor, Tensor], u: Tensor) -> tuple[Tensor, ...] | None:
    """theta_i, phi, density `[S, B]` and values `[C, S, B]`; None where a context is not valid.

    Contexts are sorted by what they need, so that each is computed by the half it needs.
    """
    run, count = kernel.program("both").run, len(context[0])
    index = torch.empty(len(NEEDS), count, dtype=torch.int32)
    counts = run.sort(*context, index)
    if counts is None:
        return None
    u = u.contiguous()
    out = *(u.new_empty(u.shape[:2]) for _ in range(3)), u.new_empty(kernel.computed_channels, *u.shape[:2])
    for need, which in zip(NEEDS, index, strict=True):
        if counts[need]:
            program = kernel.program(need)
            program.run.shade(program.tables, program.start, context, kernel.sphere, u, which, counts[need], out)
    return out
