"""Two blocks of hair of different density, side by side."""

from __future__ import annotations

from typing import Any

import torch

from dsfit.errors import InputError, as_number
from dsfit.render.geometry.block import block
from dsfit.render.geometry.build import check_length, seeded
from dsfit.render.geometry.transform import joined, translated
from dsfit.render.strands import Strands


def double_block(
    seed: int = 0,
    strands: tuple[int, int] | list[int] = (2000, 10000),
    side: float = 5.0,
    gap: float = 0.5,
    **block_options: Any,
) -> Strands:
    """Two cubes of hanging strands: a thin one at x < 0 and a dense one at x > 0, together centred at the origin.

    Unit: centimetres.

    Good camera: `suggested_view(strands, VIEWS["double_block"])`, from the right, above and in front.

    Args:
        seed: integer >= 0; the two blocks differ in more than their density.
        strands: how many in the left and in the right block.
        side: of each cube.
        gap: between the cubes, >= 0.
        block_options: `radius`, `points`, `disorder`, `flyaways` of `block`, for both.

    Raises:
        InputError: an argument outside its range.
    """
    if not isinstance(strands, tuple | list) or len(strands) != 2:
        raise InputError("double_block.strands", strands, "two integers, for the left and the right block")
    side = check_length("double_block.side", side)
    gap = as_number("double_block.gap", gap, 0.0, 1e6)
    seeds = torch.randint(2**62, (2,), generator=seeded("double_block", seed)).tolist()
    left, right = (
        block(seed=own, strands=count, side=side, **block_options) for own, count in zip(seeds, strands, strict=True)
    )
    shift = (side + gap) / 2
    return joined([translated(left, (-shift, 0.0, 0.0)), translated(right, (shift, 0.0, 0.0))])
