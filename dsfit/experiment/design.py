"""Designs of sweeps: which values the keys of `[sweep.grid]` and `[sweep.space]` take together.

A grid is all combinations of lists of values, the last key running fastest. A space is sampled: point i has the
coordinates u_i in [0, 1)^d, the i-th of a random sequence or of Sobol's (scrambled by a linear matrix and a digital
shift: Matousek 1998), and key j takes the value that its axis gives to u_ij. With both, every grid point is combined
with every sampled point, the same ones each time, so that grid points can be compared point by point. Both sequences go
on where they were when there are more points.
"""

from __future__ import annotations

import copy
import functools
import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from dsfit.experiment.reader import RawConfig, did_you_mean, set_value
from dsfit.experiment.schema import SweepConfig

MAX_POINTS = 10_000_000
_DIGITS = 12  # of sampled values: the last digits of exp and log differ between machines
_NOT_SWEPT = ("sweep", "output", "kind", "title")
_RANGE_KEYS = ("low", "high", "scale", "integer")
_SWEPT = "keys of what is computed (fiber, bsdf, light, scattering, contexts, methods, estimate)"


@dataclass(frozen=True)
class Choices:
    """Each of `values` for an equal part of [0, 1)."""

    values: list[Any]

    def at(self, u: float) -> Any:
        """The value at u in [0, 1)."""
        return self.values[min(int(u * len(self.values)), len(self.values) - 1)]


@dataclass(frozen=True)
class Range:
    """Uniform between `low` and `high`, or uniform in the logarithm; whole numbers include both ends."""

    low: float
    high: float
    log: bool = False
    integer: bool = False

    def at(self, u: float) -> float | int:
        """The value at u in [0, 1), to 12 digits."""
        high = self.high + 1 if self.integer else self.high
        if self.log:
            value = math.exp(math.log(self.low) + u * (math.log(high) - math.log(self.low)))
        else:
            value = self.low + u * (high - self.low)
        if self.integer:
            return min(max(math.floor(value), int(self.low)), int(self.high))
        return min(max(float(f"{value:.{_DIGITS}g}"), self.low), self.high)


@dataclass(frozen=True)
class Design:
    """The points of a sweep, by number.

    Attributes:
        grid: key -> its values.
        space: key -> its axis.
        kind, points, seed: how the space is sampled; `points` is 1 without a space.
        sources: key -> where its values were written, for error messages.
    """

    grid: dict[str, list[Any]]
    space: dict[str, Choices | Range]
    kind: str = "grid"
    points: int = 1
    seed: int = 1
    sources: dict[str, str] = field(default_factory=dict)

    def __len__(self) -> int:
        return math.prod(len(values) for values in self.grid.values()) * self.points

    @property
    def keys(self) -> list[str]:
        """All keys, those of the grid first."""
        return [*self.grid, *self.space]

    def values(self, number: int) -> dict[str, Any]:
        """The values of point `number`."""
        place, row = divmod(number, self.points)
        found: dict[str, Any] = {}
        for key in reversed(self.grid):
            place, index = divmod(place, len(self.grid[key]))
            found[key] = self.grid[key][index]
        found = {key: found[key] for key in self.grid}
        if self.space:
            u = self._uniforms[row]
            found.update({key: axis.at(float(u[j])) for j, (key, axis) in enumerate(self.space.items())})
        return found

    @functools.cached_property
    def _uniforms(self) -> np.ndarray:
        """Coordinates `[points, d]` in [0, 1)."""
        generator = np.random.default_rng(self.seed)
        if self.kind == "random":
            return generator.random((self.points, len(self.space)))
        from scipy.stats import qmc

        sequence = qmc.Sobol(len(self.space), scramble=True, seed=generator)
        return sequence.random_base2(max(0, math.ceil(math.log2(self.points))))[: self.points]


def design_of(raw: RawConfig, sweep: SweepConfig) -> Design:
    """The design of a config's `[sweep]`.

    Raises:
        ConfigError: naming the key that is wrong.
    """
    grid = dict(_leaves(sweep.grid, lambda node: not isinstance(node, dict)))
    space = dict(_leaves(sweep.space, _is_axis))
    _check_together(raw, sweep, bool(space))
    sources: dict[str, str] = {}
    taken: dict[str, tuple[str, ...]] = {}
    for table, found in (("grid", grid), ("space", space)):
        for parts in found:
            where, key = ("sweep", table, *parts), ".".join(parts)
            if parts[0].split(".")[0] in _NOT_SWEPT or not all(key.split(".")):
                raise raw.error(where, _SWEPT, key)
            for other, place in taken.items():
                if f"{other}.".startswith(f"{key}.") or f"{key}.".startswith(f"{other}."):
                    raise raw.error(where, f"keys apart from each other ({'.'.join(place[1:])} is swept as well)", key)
            taken[key] = where
            sources[key] = f"{raw.source(where)} (sweep.{table})"
    for parts, values in grid.items():
        if not isinstance(values, list) or not values:
            raise raw.error(("sweep", "grid", *parts), f"a list of values for {'.'.join(parts)}", values)
    axes = {".".join(parts): _axis(raw, ("sweep", "space", *parts), node) for parts, node in space.items()}
    made = Design({".".join(parts): list(values) for parts, values in grid.items()}, axes, sweep.design,
                  (sweep.points or 1) if axes else 1, sweep.seed, sources)  # fmt: skip
    if len(made) > MAX_POINTS:
        raise raw.error(("sweep",), f"at most {MAX_POINTS} points (these are {len(made)})")
    return made


def at_point(raw: RawConfig, sources: dict[str, str], values: dict[str, Any]) -> RawConfig:
    """The tables with these values written into them; `sources` are a design's.

    Raises:
        ConfigError: a key runs through something that is neither a table nor a list.
    """
    changed = raw.copy()
    for key, value in values.items():
        set_value(changed, key.split("."), copy.deepcopy(value), sources[key])
    return changed


def _leaves(node: dict[str, Any], is_leaf: Any, prefix: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], Any]]:
    """Dotted keys may be quoted (`"fiber.eta" = [...]`) or plain (`fiber.eta = [...]`), which TOML reads as nested
    tables; yields the path in the tables."""
    for key, value in node.items():
        if is_leaf(value):
            yield (*prefix, key), value
        else:
            yield from _leaves(value, is_leaf, (*prefix, key))


def _is_axis(node: Any) -> bool:
    return not isinstance(node, dict) or not node or not all(isinstance(value, dict) for value in node.values())


def _check_together(raw: RawConfig, sweep: SweepConfig, space: bool) -> None:
    if sweep.design == "grid":
        if space:
            raise raw.error(("sweep", "design"), "'random' or 'sobol' where there is a [sweep.space]", "grid")
        if sweep.points is not None:
            raise raw.error(("sweep", "points"), "nothing where the design is 'grid'")
    elif not space:
        raise raw.error(("sweep", "space"), f"at least one key, as the design is {sweep.design!r}", {})
    elif sweep.points is None:
        raise raw.error(("sweep", "points"), f"a whole number >= 1, as the design is {sweep.design!r}")


def _axis(raw: RawConfig, where: tuple[str, ...], node: Any) -> Choices | Range:
    """The axis of one key."""
    shape = "a table { low, high, scale, integer } or { choices = [...] }"
    if not isinstance(node, dict) or not node:
        raise raw.error(where, shape, node)
    known = ("choices",) if "choices" in node else _RANGE_KEYS
    for name in node:
        if name not in known:
            hint = did_you_mean(name, (*_RANGE_KEYS, "choices"))
            raise raw.error((*where, name), f"one of the keys {', '.join(known)}{hint}", node[name])
    if "choices" in node:
        if not isinstance(node["choices"], list) or not node["choices"]:
            raise raw.error((*where, "choices"), "a list of at least one value", node["choices"])
        return Choices(node["choices"])
    return _range(raw, where, node)


def _range(raw: RawConfig, where: tuple[str, ...], node: dict[str, Any]) -> Range:
    scale, integer = node.get("scale", "linear"), node.get("integer", False)
    if scale not in ("linear", "log"):
        raise raw.error((*where, "scale"), "one of 'linear', 'log'", scale)
    if not isinstance(integer, bool):
        raise raw.error((*where, "integer"), "true or false", integer)
    kinds = (int,) if integer else (int, float)
    what = "a whole number" if integer else "a finite number"
    for name in ("low", "high"):
        value = node.get(name)
        if isinstance(value, bool) or not isinstance(value, kinds) or not abs(value) <= 1e300:
            raise raw.error((*where, name), what + ("" if name in node else " (this key is required)"), value)
    low, high = node["low"], node["high"]
    if scale == "log" and low <= 0:
        raise raw.error((*where, "low"), f"{what} > 0, as the scale is 'log'", low)
    if not high > low:
        raise raw.error((*where, "high"), f"{what} > low = {low:g}", high)
    if integer and max(abs(low), abs(high)) > 2**53:
        raise raw.error((*where, "high"), "whole numbers up to 2^53", high)
    return Range(low, high, scale == "log", True) if integer else Range(float(low), float(high), scale == "log")


def all_values(design: Design) -> Iterator[dict[str, Any]]:
    """The values of every point, in order."""
    return map(design.values, itertools.islice(itertools.count(), len(design)))
