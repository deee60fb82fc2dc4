"""Scatter counts from a grid of densities against exact counts of the geometry.

Rays start on fibres, at points spread evenly over their length or at points that a camera sees, and go in directions
spread evenly over the sphere. N is the exact number of fibres that a ray meets, its own left out; n is what the grid
expects. Were fibres placed independently of one another, N would be a Poisson number of mean n: that is what
v = exp(-n) stands for.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import Tensor

from dsfit.errors import InputError
from dsfit.figures import Data, Estimate, Experiment, Measured, Settings, Work
from dsfit.render import Strands
from dsfit.render.camera import Camera
from dsfit.render.exact_counts import exact_crossings
from dsfit.render.geometry import GENERATORS, suggested_view
from dsfit.render.geometry.view import VIEWS
from dsfit.render.grid import DensityGrid
from dsfit.render.visibility import Visibility
from experiments._scatter_counts_compare import bins, brief, compare, with_errors

POINTS = ("fibres", "seen")
STEPS = (1.0, 0.5, 0.25)
_FINEST = 1 / 16


class ScatterCounts(Settings):
    """`resolutions` are voxels along the longest side; `rays` for each geometry and kind of points; `strands` of a
    geometry, its own number if left out; `speed_rays` are timed."""

    geometries: list[str] = ["block", "double_block", "wavy_bundle", "ball"]
    resolutions: list[int] = [8, 12, 16, 24, 32, 48, 64, 96]
    rays: int = 1000
    strands: int | None = None
    speed_rays: int = 20_000


def compute(settings: ScatterCounts, work: Work) -> Data:
    """Counts and times; arrays are `[geometry, resolution, kind of points, ...]`, those of times without points."""
    rows: list[dict[str, Any]] = []
    speed: list[dict[str, Any]] = []
    for k, name in enumerate(settings.geometries):
        if name not in GENERATORS:
            raise InputError(f"geometries.{k}", name, ", ".join(GENERATORS))
        strands = _strands(name, settings.strands)
        places = (on_fibres(strands, settings.rays), seen(strands, name, settings.rays))
        exact = [exact_crossings(strands, *place[:3]).to(torch.float64) for place in places]
        for resolution in settings.resolutions:
            began = time.process_time()
            grid = DensityGrid.of(strands, resolution, max_n=1e6)
            built = time.process_time() - began
            rows += [measured(grid, place, counted) for place, counted in zip(places, exact, strict=True)]
            speed.append({"speed.seconds": built, **timed(grid, places[0], settings.speed_rays)})
            work.say(f"{name}, {resolution} voxels")
    shape = (len(settings.geometries), len(settings.resolutions))
    arrays = _stacked(rows, (*shape, len(POINTS))) | _stacked(speed, shape)
    backend = str(arrays.pop("speed.backend").flat[0])
    record = {
        "geometries": settings.geometries,
        "resolutions": settings.resolutions,
        "points": POINTS,
        "rays": settings.rays,
        "others": list(OTHERS),
        "steps": STEPS,
        "speed_kinds": list(_kinds()),
        "speed": {"backend": backend},
    }
    return Data(arrays, record)


def _stacked(rows: list[dict[str, Any]], shape: tuple[int, ...]) -> dict[str, np.ndarray]:
    """Values of all rows, by name."""
    whole = {name: np.array([row[name] for row in rows]) for name in rows[0]}
    return {name: value.reshape(*shape, *value.shape[1:]) for name, value in whole.items()}


def _strands(name: str, strands: int | None) -> Strands:
    """The geometry; of the double block `strands` is a mean of its two layers, which differ by a factor of five."""
    if strands is None:
        return GENERATORS[name](seed=1)
    count: Any = (round(strands / 3), round(5 * strands / 3)) if name == "double_block" else strands
    return GENERATORS[name](seed=1, strands=count)


def on_fibres(strands: Strands, rays: int, seed: int = 1) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Origins, directions, own strands and their radii; points spread evenly over the length of all fibres."""
    generator = torch.Generator().manual_seed(seed)
    a = strands.starts
    length = (strands.points[a + 1] - strands.points[a]).norm(dim=-1)
    segment = torch.multinomial(length / length.sum(), rays, replacement=True, generator=generator)
    place = torch.rand(rays, 1, dtype=torch.float64, generator=generator)
    origin = torch.lerp(strands.points[a][segment], strands.points[a + 1][segment], place)
    radius = torch.lerp(strands.radius[a][segment], strands.radius[a + 1][segment], place[:, 0])
    return origin, _directions(rays, generator), strands.strand_of_point[a][segment], radius


def seen(strands: Strands, name: str, rays: int, seed: int = 2) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """The same at points that the geometry's usual camera sees, spread evenly over their area in the picture."""
    position, target, up, fov = suggested_view(strands, VIEWS[name])
    camera = Camera(position, target, up, fov_deg=fov, width=128, height=128)
    hits = Visibility(strands, camera).hits(range(128), range(128), 1, seed)
    generator = torch.Generator().manual_seed(seed)
    hits = hits[torch.randint(len(hits), (rays,), generator=generator)]
    return hits.position, _directions(rays, generator), hits.strand, hits.radius


def _directions(rays: int, generator: torch.Generator) -> Tensor:
    return torch.nn.functional.normalize(torch.randn(rays, 3, dtype=torch.float64, generator=generator), dim=-1)


def measured(grid: DensityGrid, given: tuple[Tensor, ...], exact: Tensor) -> dict[str, Any]:
    """The grid's n against N; and what other ways to treat the own fibre, the sine and the step would do."""
    origin, direction, _, radius = given
    n = grid.crossings(origin, direction, radius)
    found: dict[str, Any] = with_errors("counts", compare, n, exact) | bins(n, exact)
    others = [with_errors("others", brief, treat(grid, origin, direction, radius), exact) for treat in OTHERS.values()]
    found |= {name: [other[name] for other in others] for name in others[0]}
    fine = stepped(grid, _FINEST).crossings(origin, direction)
    steps = [with_errors("steps", _rms, stepped(grid, step).crossings(origin, direction) - fine) for step in STEPS]
    return found | {name: [step[name] for step in steps] for name in steps[0]}


def _rms(error: Tensor) -> dict[str, float]:
    return {"rms": float(error.square().mean().sqrt())}


def stepped(grid: DensityGrid, step: float, mode: str = "auto") -> DensityGrid:
    """The same density, marched in other steps."""
    return DensityGrid(grid.moments, grid.low, grid.voxel, step=step, max_n=grid.max_n, mode=mode)


def rooted(grid: DensityGrid) -> Callable[..., Tensor]:
    """Crossings by the root of the mean square sine, without the term for its spread."""
    other = stepped(grid, grid.step)
    if other.backend == "compiled":
        other.compiled.field.spread = 0.0
        return other.crossings

    def crossings(*ray: Tensor) -> Tensor:
        from dsfit.render.grid import march

        kept, march.SPREAD = march.SPREAD, 0.0
        try:
            return other.crossings(*ray)
        finally:
            march.SPREAD = kept

    return crossings


OTHERS: dict[str, Callable[[DensityGrid, Tensor, Tensor, Tensor], Tensor]] = {
    "from the point itself": lambda grid, origin, direction, radius: grid.crossings(origin, direction),
    "half a voxel on": lambda grid, origin, direction, radius: grid.crossings(
        origin + 0.5 * grid.voxel * direction, direction
    ),
    "root of the mean square sine": lambda grid, origin, direction, radius: rooted(grid)(origin, direction, radius),
}
"""Other treatments of the start, which keep the own fibre, and of the sine."""


def _kinds() -> dict[str, tuple[str, float]]:
    return {f"{mode}, step {step:g}": (mode, step) for mode in ("auto", "eager") for step in STEPS[:2]}


def timed(grid: DensityGrid, given: tuple[Tensor, ...], rays: int, rounds: int = 9) -> dict[str, Any]:
    """Nanoseconds of processor time a ray, the least of rounds in turn, in float32 and one thread; and bytes."""
    torch.set_num_threads(1)
    index = torch.arange(rays) % len(given[0])
    origin = given[0][index].to(torch.float32)
    direction = _directions(rays, torch.Generator().manual_seed(3)).to(torch.float32)
    grids = {name: stepped(grid, step, mode) for name, (mode, step) in _kinds().items()}
    least = dict.fromkeys(grids, float("inf"))
    for turn in range(rounds):
        for name, other in grids.items():
            if turn > 2 and "eager" in name:
                continue
            count = max(1, rays // 10) if "eager" in name else rays
            began = time.process_time()
            other.crossings(origin[:count], direction[:count])
            least[name] = min(least[name], (time.process_time() - began) / count * 1e9)
    return {
        "speed.backend": grid.backend,
        "speed.nanoseconds": list(least.values()),
        "speed.memory": grid.memory,
        "voxels": list(grid.shape),
    }


EXPERIMENT = Experiment(
    title="Scatter counts of the voxel grid",
    shows="Numbers of crossed fibres that the grid expects against exact counts: bias, scatter, shares of rays that "
    "cross none, and the two rules for the lit share v.",
    settings=ScatterCounts,
    compute=compute,
    minutes=1.4,
    reproduces={
        "speed.*": Measured(),
        "bins.zero": Estimate(error="error.bins.zero", most=math.inf),
        "bins.*": Measured(),  # where the bins' rays happen to lie
        "counts.*": Estimate(error="error.counts.*", most=math.inf),
        "others.*": Estimate(error="error.others.*", most=math.inf),
        "steps.*": Estimate(error="error.steps.*", most=math.inf),
    },
    small=('geometries=["block", "double_block"]', "resolutions=[8, 24]", "rays=60", "strands=200", "speed_rays=500"),
)
