"""A family of hair fibres: ranges of its parameters, fibres drawn from it, and whether a fibre belongs to it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from dsfit.bsdf.dual_scattering import DualScattering
from dsfit.bsdf.fiber import Fiber
from dsfit.errors import InputError, as_number
from dsfit.random import uniforms

_DEG = math.pi / 180
EUMELANIN = (0.419, 0.697, 1.37)
PHEOMELANIN = (0.187, 0.4, 1.05)
"""Absorption per unit of either pigment in red, green and blue (d'Eon et al. 2011); only their ratios matter here."""
_SHIFTS = (1.0, -0.5, -1.5)
_WIDTHS = (1.0, 0.5, 2.0)
_SLACK = 1e-3


@dataclass(frozen=True)
class FiberFamily:
    """Ranges (low, high) of a family of fibres, angles in degrees.

    Args:
        absorption: sigma_a of the most absorbing channel. Fibres are drawn with its logarithm uniform, and one in
            twenty with no absorption at all; every channel may lie between 0 and the upper end.
        width: beta_R.
        spread: factor by which beta_TT may differ from beta_R / 2, and beta_TRT from 2 beta_R, either way.
        shift: alpha_R; alpha_TT = -alpha_R / 2 and alpha_TRT = -3 alpha_R / 2.
        eccentricity: of the section.
        eccentric: share of fibres drawn with a section that is not round.
        density: d_f and d_b, each by itself.

    Colours are mixtures of eumelanin, pheomelanin and grey. All else (index, caustic) is `Fiber`'s default.

    Raises:
        InputError: a range that is empty or outside what the BSDF allows.

    Example:
        >>> import torch
        >>> import dsfit
        >>> fibers = dsfit.FiberFamily(absorption=(0.1, 1.0), eccentric=0.0).draw(4, torch.Generator().manual_seed(0))
        >>> all(bsdf.fiber.is_round and float(bsdf.fiber.sigma_a.max()) <= 1 for bsdf in fibers)
        True
    """

    absorption: tuple[float, float] = (0.01, 12.0)
    width: tuple[float, float] = (4.0, 14.0)
    spread: float = 1.4
    shift: tuple[float, float] = (-10.0, -2.0)
    eccentricity: tuple[float, float] = (0.85, 1.0)
    eccentric: float = 0.25
    density: tuple[float, float] = (0.5, 0.9)

    def __post_init__(self) -> None:
        limits = {
            "absorption": (0.0, 1e3),
            "width": (0.1, 60.0),
            "shift": (-45.0, 45.0),
            "eccentricity": (math.sqrt(0.5), math.sqrt(2.0)),
            "density": (0.0, 1.0),
        }
        for name, (low, high) in limits.items():
            pair = getattr(self, name)
            if not isinstance(pair, tuple | list) or len(pair) != 2:
                raise InputError(f"family.{name}", pair, "a pair (low, high)")
            first = as_number(f"family.{name}[0]", pair[0], low, high, open_low=name != "shift")
            second = as_number(f"family.{name}[1]", pair[1], first, high)
            object.__setattr__(self, name, (first, second))
        as_number("family.spread", self.spread, 1.0, 4.0)
        as_number("family.eccentric", self.eccentric, 0.0, 1.0)

    def draw(self, count: int, generator: torch.Generator) -> list[DualScattering]:
        """`count` BSDFs of the family, by scrambled Sobol points; equal generator states give equal fibres.

        Raises:
            InputError: count < 1.
        """
        if isinstance(count, bool) or not isinstance(count, int) or count < 1:
            raise InputError("count", count, "an integer >= 1")
        return [self._fiber(x) for x in uniforms((count,), 12, generator=generator, kind="sobol")]

    def _fiber(self, x: Tensor) -> DualScattering:
        def between(u: float, pair: tuple[float, float]) -> float:
            return pair[0] + (pair[1] - pair[0]) * u

        u = x.tolist()
        log_range = (math.log(self.absorption[0]), math.log(self.absorption[1]))
        largest = 0.0 if u[0] < 0.05 else math.exp(between((u[0] - 0.05) / 0.95, log_range))
        pigment = torch.lerp(torch.tensor(EUMELANIN), torch.tensor(PHEOMELANIN), u[1])
        colour = torch.lerp(pigment / pigment.max(), torch.ones(3), u[2] ** 2)
        width = between(u[3], self.width)
        factors = [1.0, *(self.spread ** (2 * v - 1) for v in u[4:6])]
        round_section = u[7] >= self.eccentric
        fiber = Fiber(
            sigma_a=(largest * colour).tolist(),
            beta=[_DEG * width * k * f for k, f in zip(_WIDTHS, factors, strict=True)],
            alpha=[_DEG * between(u[6], self.shift) * k for k in _SHIFTS],
            eccentricity=1.0 if round_section else between(u[8], self.eccentricity),
        )
        return DualScattering(fiber, d_f=between(u[9], self.density), d_b=between(u[10], self.density))

    def outside(self, bsdf: DualScattering) -> dict[str, tuple[float, str]]:
        """Every field in which a fibre lies outside the family, with its value and what the family allows."""
        fiber = bsdf.fiber
        alpha, beta = fiber.alpha.detach() / _DEG, fiber.beta.detach() / _DEG
        default = Fiber()
        spread = (1 / self.spread, self.spread)
        values = {
            "sigma_a": (fiber.sigma_a.max(), (0.0, self.absorption[1])),
            "beta_R": (beta[0], self.width),
            "beta_TT / (beta_R / 2)": (2 * beta[1] / beta[0], spread),
            "beta_TRT / (2 beta_R)": (beta[2] / (2 * beta[0]), spread),
            "alpha_R": (alpha[0], self.shift),
            "alpha_TT / alpha_R": (alpha[1] / alpha[0], (-0.5, -0.5)),
            "alpha_TRT / alpha_R": (alpha[2] / alpha[0], (-1.5, -1.5)),
            "eccentricity": (fiber.eccentricity, self.eccentricity),
            "d_f": (bsdf.d_f, self.density),
            "d_b": (bsdf.d_b, self.density),
        }
        for name in ("eta", "caustic_width", "glint_scale", "caustic_fade", "caustic_max_offset"):
            only = float(getattr(default, name))
            values[name] = (getattr(fiber, name), (only, only))
        found = {}
        for name, (value, (low, high)) in values.items():
            number = float(value)
            slack = _SLACK * max(abs(low), abs(high))
            if not low - slack <= number <= high + slack:
                found[name] = (number, f"[{low:.6g}, {high:.6g}]" if low < high else f"{low:.6g}")
        return found


__all__ = ["FiberFamily"]
