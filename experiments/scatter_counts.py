"""Scatter counts from a grid of densities against exact counts of the geometry.

    python experiments/scatter_counts.py --out DIR [--quick]     (measures: about five minutes)
    python experiments/scatter_counts.py --plot DIR              (figure and table of what was measured)

Rays start on fibres, at points spread evenly over their length or at points that a camera sees, and go in directions
spread evenly over the sphere. N is the exact number of fibres that a ray meets, its own left out; n is what the grid
expects. Were fibres placed independently of one another, N would be a Poisson number of mean n: that is what
v = exp(-n) stands for. Writes scatter_counts.json, .png, .pdf and .md.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from _scatter_counts_compare import compare
from torch import Tensor

from dsfit.render import Strands
from dsfit.render.camera import Camera
from dsfit.render.exact_counts import exact_crossings
from dsfit.render.geometry import GENERATORS, suggested_view
from dsfit.render.geometry.view import VIEWS
from dsfit.render.grid import DensityGrid
from dsfit.render.visibility import Visibility

NAME = "scatter_counts.json"
GEOMETRIES = ("block", "double_block", "wavy_bundle", "ball")
RESOLUTIONS = (8, 12, 16, 24, 32, 48, 64, 96)
STEPS = (1.0, 0.5, 0.25)
_FINEST = 1 / 16


def compute(folder: Path, quick: bool) -> dict[str, Any]:
    """Measure; also writes the data to `folder`."""
    from dsfit.experiment.files import write_json
    from dsfit.experiment.provenance import provenance

    start, rays = time.perf_counter(), 60 if quick else 1000
    rows, speed = [], []
    for name in GEOMETRIES[:2] if quick else GEOMETRIES:
        strands = _strands(name, quick)
        places = {"fibres": on_fibres(strands, rays), "seen": seen(strands, name, rays)}
        exact = {}
        for where, (origin, direction, own, _) in places.items():
            exact[where] = exact_crossings(strands, origin, direction, own).to(torch.float64)
        for resolution in (8, 24) if quick else RESOLUTIONS:
            began = time.perf_counter()
            grid = DensityGrid.of(strands, resolution, max_n=1e6)
            built = time.perf_counter() - began
            for where, given in places.items():
                common = {"geometry": name, "points": where, "resolution": resolution, "voxel": grid.voxel}
                rows.append(common | measured(grid, given, exact[where]))
            speed.append(
                {"geometry": name, "resolution": resolution, "seconds": built}
                | timed(grid, places["fibres"], 500 if quick else 20_000)
            )
    data = {
        "provenance": provenance(),
        "quick": quick,
        "rays": rays,
        "seconds": time.perf_counter() - start,
        "rows": rows,
        "speed": speed,
    }
    write_json(folder / NAME, data)
    return data


def _strands(name: str, quick: bool) -> Strands:
    count: Any = (60, 300) if name == "double_block" else 200
    return GENERATORS[name](seed=1, **({"strands": count} if quick else {}))


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
    others = {
        "from the point itself": grid.crossings(origin, direction),
        "half a voxel on": grid.crossings(origin + 0.5 * grid.voxel * direction, direction),
        "root of the mean square sine": rooted(grid)(origin, direction, radius),
    }
    fine = stepped(grid, _FINEST).crossings(origin, direction)
    steps = {f"{step:g}": stepped(grid, step).crossings(origin, direction) - fine for step in STEPS}
    few = n <= 1
    return compare(n, exact, few) | {
        "others": {name: compare(other, exact, few, bins=False) for name, other in others.items()},
        "steps": {name: float(error.square().mean().sqrt()) for name, error in steps.items()},
    }


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


def timed(grid: DensityGrid, given: tuple[Tensor, ...], rays: int, rounds: int = 9) -> dict[str, Any]:
    """Nanoseconds of processor time a ray, the least of rounds in turn, in float32 and one thread; and bytes."""
    torch.set_num_threads(1)
    index = torch.arange(rays) % len(given[0])
    origin = given[0][index].to(torch.float32)
    direction = _directions(rays, torch.Generator().manual_seed(3)).to(torch.float32)
    grids = {f"{mode}, step {step:g}": stepped(grid, step, mode) for mode in ("auto", "eager") for step in STEPS[:2]}
    least = dict.fromkeys(grids, float("inf"))
    for turn in range(rounds):
        for name, other in grids.items():
            if turn > 2 and "eager" in name:
                continue
            count = rays // 10 if "eager" in name else rays
            began = time.process_time()
            other.crossings(origin[:count], direction[:count])
            least[name] = min(least[name], (time.process_time() - began) / count * 1e9)
    _ = grid.backend
    return {"backend": grid.backend, "nanoseconds": least, "memory": grid.memory, "voxels": list(grid.shape)}


def main(arguments: list[str] | None = None) -> None:
    """Command line; see the module text."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--out", type=Path, help="measure, and write data, figure and table to this folder")
    parser.add_argument("--plot", type=Path, help="figure and table of the data in this folder")
    parser.add_argument("--quick", action="store_true", help="few strands, few rays, two grids")
    given = parser.parse_args(arguments)
    folder = given.out or given.plot
    if folder is None:
        parser.error("--out or --plot is needed")
    if given.out is not None:
        compute(folder, given.quick)
    from _scatter_counts_report import figure, table

    data = json.loads((folder / NAME).read_text())
    (folder / "scatter_counts.md").write_text(table(data))
    figure(data, folder)
    print((folder / "scatter_counts.md").read_text())


if __name__ == "__main__":
    main()
