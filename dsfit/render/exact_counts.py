"""How many fibres a ray crosses, from the geometry itself: what a grid of densities approximates.

A fibre is the union of round cylinders around the segments of its strand, each with the mean radius of its two ends,
joined by balls at the inner points so that bends leave no gap, and cut off flat at root and tip. A ray crosses it as
many times as it enters that union: segments that meet at a joint count once, a strand that comes back counts again.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from dsfit.errors import InputError, check_finite
from dsfit.render.strands import Strands

_GROUP = 8
"""Segments of a strand that are first tested together, by a ball around them."""
_PAIRS = 500_000
"""Pairs of a ray and a group looked at in one pass: up to a few hundred MB."""


def exact_crossings(strands: Strands, origin: Tensor, direction: Tensor, own: Tensor | int = -1) -> Tensor:
    """Number of fibres that half-lines enter, in float64 and exact up to rounding.

    In a field of fibres that are independent of the half-line (a Poisson field of lines), the mean is the integral of
    length density x 2 radius x sin(angle between ray and fibre) along it. A fibre that the origin lies inside of is not
    entered at the origin, so it does not count.

    Args:
        strands: the hair.
        origin: `[*batch, 3]`, where the half-lines start.
        direction: `[*batch, 3]`, of any length but 0.
        own: `[*batch]` integers or one: the strand that the origin sits on, or -1 for none. Where the half-line enters
            this strand within two radii from the origin, that is the fibre itself and is left out, so the origin may be
            on the axis, on the surface or anywhere on a ribbon facing the camera; further on it counts again.

    Returns:
        `[*batch]` int64.

    Raises:
        InputError: shapes that do not fit, numbers that are not finite, a direction of length 0, an unknown strand.
    """
    batch, origin, direction, own = _checked(strands, origin, direction, own)
    tubes = _Tubes.of(strands)
    found = []
    rays = max(1, _PAIRS // len(tubes.group_first))
    for start in range(0, len(origin), rays):
        part = slice(start, start + rays)
        found.append(_count(tubes, origin[part], direction[part], own[part]))
    return torch.cat(found).reshape(batch) if found else torch.zeros(batch, dtype=torch.int64)


def _checked(
    strands: Strands, origin: Tensor, direction: Tensor, own: Tensor | int
) -> tuple[torch.Size, Tensor, Tensor, Tensor]:
    """Rays `[N, 3]`, unit directions `[N, 3]`, own strands `[N]` and the shape they came in."""
    for name, value in (("origin", origin), ("direction", direction)):
        if not isinstance(value, Tensor) or not value.is_floating_point() or value.ndim < 1 or value.shape[-1] != 3:
            raise InputError(f"exact_crossings.{name}", getattr(value, "shape", value), "a float tensor [*batch, 3]")
        check_finite(f"exact_crossings.{name}", value)
    own = torch.as_tensor(own)
    if own.is_floating_point() or own.is_complex() or own.dtype == torch.bool:
        raise InputError("exact_crossings.own", own.dtype, "integers: indices of strands, or -1")
    try:
        batch = torch.broadcast_shapes(origin.shape[:-1], direction.shape[:-1], own.shape)
    except RuntimeError:
        shapes = tuple(map(tuple, (origin.shape, direction.shape, own.shape)))
        raise InputError("exact_crossings", shapes, "an origin, a direction and an own strand for each ray") from None
    if own.numel() and not (-1 <= int(own.min()) and int(own.max()) < len(strands)):
        raise InputError("exact_crossings.own", own.tolist(), f"integers in [-1, {len(strands) - 1}]")
    length = direction.detach().double().norm(dim=-1, keepdim=True)
    if not bool((length > 0).all()):
        raise InputError("exact_crossings.direction", 0.0, "vectors of a length > 0")
    unit = (direction.detach().double() / length).expand(*batch, 3).reshape(-1, 3)
    start = origin.detach().double().expand(*batch, 3).reshape(-1, 3)
    return batch, start, unit, own.to(torch.int64).expand(batch).reshape(-1)


@dataclass(frozen=True)
class _Tubes:
    """Segments, and groups of consecutive segments of a strand in balls.

    start, axis, length, radius, strand: of segments `[M]`; ball_start, ball_end: whether a segment has a ball there.
    group_first, group_count: `[G]`, the segments of a group; group_centre, group_reach: its ball.
    """

    start: Tensor
    axis: Tensor
    length: Tensor
    radius: Tensor
    strand: Tensor
    ball_start: Tensor
    ball_end: Tensor
    group_first: Tensor
    group_count: Tensor
    group_centre: Tensor
    group_reach: Tensor

    @classmethod
    def of(cls, strands: Strands) -> _Tubes:
        points, width = strands.points.detach().double(), strands.radius.detach().double()
        first, starts = strands.first, strands.starts
        start, end = points[starts], points[starts + 1]
        radius = (width[starts] + width[starts + 1]) / 2
        length = (end - start).norm(dim=-1)
        strand = strands.strand_of_point[starts]
        place = starts - first[strand]  # of a segment in its strand
        group_first = torch.nonzero(place % _GROUP == 0).flatten()
        group_count = torch.cat([group_first, torch.tensor([len(starts)])]).diff()
        group = torch.repeat_interleave(torch.arange(len(group_first)), group_count)
        middle = (start + end) / 2
        centre = torch.zeros(len(group_first), 3, dtype=torch.float64).index_add_(0, group, middle)
        centre = centre / group_count[:, None]
        reach = (middle - centre[group]).norm(dim=-1) + length / 2 + radius
        widest = torch.zeros(len(group_first), dtype=torch.float64).scatter_reduce_(0, group, reach, "amax")
        return cls(
            start=start,
            axis=(end - start) / length.clamp_min(torch.finfo(torch.float64).tiny)[:, None],
            length=length,
            radius=radius,
            strand=strand,
            ball_start=place > 0,
            ball_end=starts + 2 < first[strand + 1],
            group_first=group_first,
            group_count=group_count,
            group_centre=centre,
            group_reach=widest * (1 + 1e-9),
        )


def _count(tubes: _Tubes, origin: Tensor, direction: Tensor, own: Tensor) -> Tensor:
    """Crossings `[N]` of a few rays."""
    ray, segment = _candidates(tubes, origin, direction)
    enter, leave = _intervals(tubes, origin[ray], direction[ray], segment)
    hit = leave > enter
    ray, segment, enter, leave = ray[hit], segment[hit], enter[hit], leave[hit]
    strand = tubes.strand[segment]
    key = ray * (int(tubes.strand[-1]) + 1) + strand
    order = torch.argsort(enter)
    order = order[torch.argsort(key[order], stable=True)]
    key, ray, strand, enter, leave = key[order], ray[order], strand[order], enter[order], leave[order]
    # entered: beyond all that the ray has left behind of this strand before
    entered = enter > _left_before(key, leave)
    near = 2 * tubes.radius[segment[order]]
    outside = enter > torch.where(strand == own[ray], near, 0.0)
    return torch.zeros(len(origin), dtype=torch.int64).index_add_(0, ray, (entered & outside).to(torch.int64))


def _candidates(tubes: _Tubes, origin: Tensor, direction: Tensor) -> tuple[Tensor, Tensor]:
    """Pairs (ray, segment) that may meet: the ray passes the group's ball, and the ball around the segment."""
    centre, reach = tubes.group_centre, tubes.group_reach
    middle = centre.mean(0)  # distances from here lose the fewest digits
    centre, moved = centre - middle, origin - middle
    forward = direction @ centre.T - (direction * moved).sum(-1, keepdim=True)
    squared = (centre**2).sum(-1) - 2 * moved @ centre.T + (moved**2).sum(-1, keepdim=True)
    slack = 1e-12 * (centre.abs().max() + moved.abs().max()) ** 2
    ray, group = torch.nonzero((squared - forward**2 <= reach**2 + slack) & (forward >= -reach), as_tuple=True)
    count = tubes.group_count[group]
    pair = torch.repeat_interleave(torch.arange(len(group)), count)
    inside = torch.arange(len(pair)) - (count.cumsum(0) - count)[pair]
    ray, segment = ray[pair], tubes.group_first[group][pair] + inside
    half = tubes.length[segment] / 2
    way = tubes.start[segment] + half[:, None] * tubes.axis[segment] - origin[ray]
    forward = (way * direction[ray]).sum(-1)
    aside = (way - forward[:, None] * direction[ray]).square().sum(-1)
    reach = (half + tubes.radius[segment]) * (1 + 1e-9)
    keep = (aside <= reach**2) & (forward >= -reach)
    return ray[keep], segment[keep]


def _intervals(tubes: _Tubes, origin: Tensor, direction: Tensor, segment: Tensor) -> tuple[Tensor, Tensor]:
    """Where rays are inside segments, from `enter` to `leave` along the ray; enter > leave where they never are.

    A cylinder with balls on its ends is convex, so the ray is inside it in one interval, from the first to the last
    point of the parts.
    """
    start, axis, length = tubes.start[segment], tubes.axis[segment], tubes.length[segment]
    radius = tubes.radius[segment]
    shift = ((start - origin) * direction).sum(-1)  # count from the point closest to the segment's start
    way = origin + shift[:, None] * direction - start
    low, high = _in_cylinder(way, direction, axis, length, radius)
    for ball, centre in ((tubes.ball_start, way), (tubes.ball_end, way - length[:, None] * axis)):
        ball_low, ball_high = _in_ball(centre, direction, radius)
        present = ball[segment] & (ball_high > ball_low)
        low = torch.where(present, torch.minimum(low, ball_low), low)
        high = torch.where(present, torch.maximum(high, ball_high), high)
    return low + shift, high + shift


def _in_ball(way: Tensor, direction: Tensor, radius: Tensor) -> tuple[Tensor, Tensor]:
    """The interval of a line `way + t direction` in a ball around 0; (inf, -inf) where it passes by."""
    nearest = -(way * direction).sum(-1)
    room = radius**2 - (way + nearest[:, None] * direction).square().sum(-1)
    half = room.clamp_min(0).sqrt()
    inside = room > 0
    return torch.where(inside, nearest - half, torch.inf), torch.where(inside, nearest + half, -torch.inf)


def _in_cylinder(
    way: Tensor, direction: Tensor, axis: Tensor, length: Tensor, radius: Tensor
) -> tuple[Tensor, Tensor]:
    """The interval of a line `way + t direction` in a cylinder from 0 along `axis`; (inf, -inf) where it passes by."""
    along, height = (direction * axis).sum(-1), (way * axis).sum(-1)
    across, offset = direction - along[:, None] * axis, way - height[:, None] * axis
    a, b = across.square().sum(-1), (across * offset).sum(-1)
    parallel = a < 1e-24
    safe = torch.where(parallel, 1.0, a)
    nearest = torch.where(parallel, 0.0, -b / safe)
    room = radius**2 - (offset + nearest[:, None] * across).square().sum(-1)
    half = torch.where(parallel, torch.inf, (room.clamp_min(0) / safe).sqrt())
    low, high = nearest - half, nearest + half
    flat = along.abs() < 1e-12  # the line stays at one height
    slope = torch.where(flat, 1.0, along)
    ends = torch.stack([-height / slope, (length - height) / slope])
    within = (height >= 0) & (height <= length)
    low = torch.where(flat, torch.where(within, low, torch.inf), torch.maximum(low, ends.amin(0)))
    high = torch.where(flat, torch.where(within, high, -torch.inf), torch.minimum(high, ends.amax(0)))
    inside = (room > 0) & (high > low)
    return torch.where(inside, low, torch.inf), torch.where(inside, high, -torch.inf)


def _left_before(key: Tensor, leave: Tensor) -> Tensor:
    """The largest `leave` among the earlier entries of the same key (keys sorted), -inf for the first of a key."""
    before = torch.full_like(leave, -torch.inf)
    if len(leave) > 1:
        before[1:] = torch.where(key[1:] == key[:-1], leave[:-1], -torch.inf)
    step = 1
    while step < len(key):
        same = key[step:] == key[:-step]
        if not bool(same.any()):
            break
        before[step:] = torch.where(same, torch.maximum(before[step:], before[:-step]), before[step:])
        step *= 2
    return before
