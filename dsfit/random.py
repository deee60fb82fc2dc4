"""Uniform numbers in the open unit cube from an explicit generator: independent, scrambled Sobol or Latin hypercube."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import torch
from torch import Tensor
from torch.quasirandom import SobolEngine

from dsfit.errors import InputError, check_choice

KINDS = ("random", "sobol", "stratified")
"""Allowed values of `kind`."""

_BITS = 52
"""Binary digits of a scrambled Sobol number: the most for which (digits + 1/2) 2^-52 is exact in float64."""
_MIN_STRATA = 256
"""Least number of strata of a Latin hypercube that is drawn in pieces."""


def uniforms(
    shape: Sequence[int],
    dimension: int,
    *,
    generator: torch.Generator,
    kind: str = "random",
    dtype: torch.dtype = torch.float64,
    device: torch.device | str | None = None,
) -> Tensor:
    """Uniform numbers `[*shape, dimension]` in the open interval (0, 1), also in float32.

    The first entry of `shape` counts the points of one point set; every further index is an independent randomisation
    of the set. Averages over the first axis are unbiased for all kinds.

    Args:
        shape: (points, *randomisations).
        dimension: numbers per point.
        generator: the only source of randomness; equal states give equal numbers. It may live on another device than
            the result.
        kind: `random`: independent; `sobol`: Sobol points with random linear scrambling and digital shift (Matousek
            1998, J. Complexity 14), natural order, so any aligned run of 2^k points is a digital net; `stratified`:
            Latin hypercube, one jittered point in each of the equal strata of every dimension, with independent
            permutations (McKay et al. 1979).
        dtype: float64 or float32.
        device: of the result; left out, that of the generator.

    Raises:
        InputError: unknown kind or dtype, bad shape or dimension, no generator.

    Example:
        >>> import torch
        >>> from dsfit.random import uniforms
        >>> u = uniforms((1024,), 2, generator=torch.Generator().manual_seed(0), kind="sobol")
        >>> bool(((u.mean(0) - 0.5).abs() < 1e-3).all())
        True
    """
    return torch.cat(list(uniform_chunks(shape, dimension, generator=generator, kind=kind, dtype=dtype, device=device)))


def uniform_chunks(
    shape: Sequence[int],
    dimension: int,
    *,
    generator: torch.Generator,
    kind: str = "random",
    rows: int | None = None,
    dtype: torch.dtype = torch.float64,
    device: torch.device | str | None = None,
) -> Iterator[Tensor]:
    """The points of `uniforms` in pieces of at most `rows` points, holding only one piece in memory.

    Sobol pieces are rounded down to a power of two and are exactly those of one long sequence. A Latin hypercube of
    more than max(rows, 256) points is made of independent hypercubes of that many: each is unbiased, and its strata are
    fine already. Arguments and errors as for `uniforms`.
    """
    check_choice("uniforms.kind", kind, KINDS)
    if not isinstance(generator, torch.Generator):
        raise InputError("uniforms.generator", generator, "a torch.Generator")
    if dtype not in (torch.float32, torch.float64):
        raise InputError("uniforms.dtype", dtype, "torch.float32 or torch.float64")
    if not isinstance(shape, Sequence):
        raise InputError("uniforms.shape", shape, "a sequence of integers >= 0, the number of points first")
    shape = tuple(shape)
    if not shape or any(isinstance(n, bool) or not isinstance(n, int) or n < 0 for n in shape):
        raise InputError("uniforms.shape", shape, "one or more integers >= 0, the number of points first")
    if isinstance(dimension, bool) or not isinstance(dimension, int) or not 1 <= dimension <= SobolEngine.MAXDIM:
        raise InputError("uniforms.dimension", dimension, f"an integer from 1 to {SobolEngine.MAXDIM}")
    target = torch.device(device) if device is not None else generator.device
    rows = max(1, shape[0] if rows is None else min(rows, shape[0]))
    make = {"random": _random, "sobol": _sobol, "stratified": _stratified}[kind]
    return make(shape[0], (*shape[1:], dimension), rows, generator, dtype, target)


def child(generator: torch.Generator) -> torch.Generator:
    """A new generator on the same device, seeded by one draw from `generator`."""
    seed = int(torch.randint(2**62, (), generator=generator, device=generator.device))
    return torch.Generator(generator.device).manual_seed(seed)


def _pieces(total: int, rows: int) -> list[int]:
    return [min(rows, total - start) for start in range(0, total, rows)] or [0]


def _rand(shape: tuple[int, ...], generator: torch.Generator, dtype: torch.dtype) -> Tensor:
    return torch.rand(shape, generator=generator, dtype=dtype, device=generator.device)


def _random(
    total: int, outer: tuple[int, ...], rows: int, generator: torch.Generator, dtype: torch.dtype, device: torch.device
) -> Iterator[Tensor]:
    # torch.rand is a multiple of eps / 2 in [0, 1): only the 0 has to move, to the middle of its cell
    for n in _pieces(total, rows):
        yield _rand((n, *outer), generator, dtype).clamp_min(torch.finfo(dtype).eps / 4).to(device)


def _stratified(
    total: int, outer: tuple[int, ...], rows: int, generator: torch.Generator, dtype: torch.dtype, device: torch.device
) -> Iterator[Tensor]:
    eps = torch.finfo(dtype).eps
    for strata in _pieces(total, max(rows, min(total, _MIN_STRATA))):
        order = _rand((strata, *outer), generator, torch.float64).argsort(dim=0)
        u = (order + _rand((strata, *outer), generator, torch.float64)) / max(strata, 1)
        u = u.to(dtype).clamp(eps / 4, 1 - eps / 2)
        yield from (piece.to(device) for piece in u.split(_pieces(strata, rows)))


def _sobol(
    total: int, outer: tuple[int, ...], rows: int, generator: torch.Generator, dtype: torch.dtype, device: torch.device
) -> Iterator[Tensor]:
    levels = max(1, (total - 1).bit_length())
    if levels > SobolEngine.MAXBIT:
        raise InputError("uniforms.shape[0]", total, f"at most 2^{SobolEngine.MAXBIT} Sobol points")
    bits = {"high": 2**_BITS, "generator": generator, "device": generator.device}
    shift = torch.randint(size=outer, **bits).to(device)
    columns = torch.randint(size=(levels, *outer), **bits).to(device)
    directions = _scramble(SobolEngine(outer[-1]).sobolstate.to(device), columns, levels)
    low = rows.bit_length() - 1 if rows < total else levels
    points = shift.unsqueeze(0)
    for k in range(low):
        points = torch.cat([points, points ^ directions[k]])
    for piece, n in enumerate(_pieces(total, 2**low)):
        digits = points[:n]
        for k in range(low, levels):
            if piece >> (k - low) & 1:
                digits = digits ^ directions[k]
        yield _to_open_unit(digits, dtype)


def _scramble(state: Tensor, columns: Tensor, levels: int) -> Tensor:
    """Direction numbers `[levels, ..., d]` after a random lower triangular digit matrix.

    Column j of the matrix is stored as one integer: digit j (from the top) is 1, the digits below are random. A
        direction number with
    digits b_j becomes XOR_j b_j column_j; direction number k has no digits beyond k.
    """
    top = _BITS - 1
    columns = [(columns[j] & ((1 << (top - j)) - 1)) | (1 << (top - j)) for j in range(levels)]
    scrambled = []
    for k in range(levels):
        value = torch.zeros_like(columns[0])
        for j in range(k + 1):
            digit = (state[:, k] >> (SobolEngine.MAXBIT - 1 - j)) & 1
            value = value ^ (columns[j] * digit)
        scrambled.append(value)
    return torch.stack(scrambled)


def _to_open_unit(digits: Tensor, dtype: torch.dtype) -> Tensor:
    kept = round(-math.log2(torch.finfo(dtype).eps))
    return ((digits >> (_BITS - kept)).to(dtype) + 0.5) * 2.0**-kept
