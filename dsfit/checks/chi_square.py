"""Chi-square test of a sampler against its own density, over cells of (theta_i, phi) with integrated probability.

Source: Jakob's chi2 test in Mitsuba and PBRT's bsdfs_test, with cells that adapt to the sampler, an integration with an
error bound, and Šidák's correction over everything that is tested.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from scipy import stats
from torch import Tensor

from dsfit.checks.cells import CellGrid, adapted_grid, cell_masses
from dsfit.checks.finding import Finding
from dsfit.checks.subject import Outcome, Say, Subject, silent
from dsfit.context import Context
from dsfit.errors import InputError
from dsfit.frame import HALF_PI, wrap
from dsfit.proposals.base import Distribution, Proposal
from dsfit.proposals.mixture import MixtureDistribution
from dsfit.random import uniforms

SUITE = "chi_square"
POOL = 5.0
_PILOT = 4096
_AT_ONCE = 500_000
_SHOWN = 6  # proposals whose cells are kept for the plots, the least likely ones


@dataclass(frozen=True)
class ChiSquare:
    """Outcome of the test for one proposal and one context.

    Attributes:
        p_value: 0 if a sample was outside the sphere of directions or not finite.
        statistic, degrees: chi-square and its degrees of freedom, cells of expected count below 5 pooled.
        mass, mass_error: int p domega over the sphere, 1 for a density, and the bound of the integration's error.
        invalid: number of samples that were NaN, infinite or beyond theta = +-pi/2.
        grid: the cells.
        observed, expected: counts `[T, P]`.
        blur: largest error of an expected count, in standard deviations of the count.
    """

    p_value: float
    statistic: float
    degrees: int
    mass: float
    mass_error: float
    invalid: int
    grid: CellGrid
    observed: Tensor
    expected: Tensor
    blur: float


def pooled_chi_square(observed: Tensor, expected: Tensor) -> tuple[float, float, int]:
    """p-value, statistic and degrees of freedom of counts against expected counts of the same total.

    Cells of expected count below 5 are pooled into one; if that is below 5 as well, it joins the rarest other cell. A
    count where nothing is expected at all gives p = 0.
    """
    observed, expected = observed.double().flatten(), expected.double().flatten()
    rare = expected < POOL
    seen, wanted = observed[~rare], expected[~rare]
    pool_seen, pool_wanted = observed[rare].sum(), expected[rare].sum()
    if len(wanted) == 0 or pool_wanted >= POOL:
        seen, wanted = torch.cat([seen, pool_seen[None]]), torch.cat([wanted, pool_wanted[None]])
    else:
        k = int(wanted.argmin())
        seen, wanted = seen.clone(), wanted.clone()
        seen[k] += pool_seen
        wanted[k] += pool_wanted
        # so few were expected there that joining them could hide many
        if float(pool_seen) > 0 and stats.poisson.sf(float(pool_seen) - 1, float(pool_wanted)) < 1e-12:
            return 0.0, math.inf, len(wanted)
    if len(wanted) < 2:
        return 1.0, 0.0, 0
    statistic = float(((seen - wanted) ** 2 / wanted).sum())
    return float(stats.chi2.sf(statistic, len(wanted) - 1)), statistic, len(wanted) - 1


def chi_square(
    proposal: Proposal,
    context: Context,
    samples: int = 100_000,
    cells: tuple[int, int] = (24, 16),
    *,
    generator: torch.Generator,
    rtol: float = 1e-6,
) -> ChiSquare:
    """Draw directions and compare their counts per cell with the integral of the density over the cell.

    Half of the cells' edges lie at quantiles of a pilot sample, so that narrow lobes are resolved; the expected counts
    come from the density alone. The total is compared as well (`mass`): a density that is right in shape and wrong in
    scale has p_value 1 and a mass that is not 1.

    Args:
        proposal: anything that returns a `Distribution`.
        context: a single context; its dtype is that of the samples.
        samples: directions drawn, after a pilot of 4096 others.
        cells: about how many in theta_i and in phi.
        generator: of the uniforms.
        rtol: of the integration.

    Raises:
        InputError: the context is a batch, or fewer than 100 samples.

    Example:
        >>> import torch
        >>> import dsfit
        >>> from dsfit.checks.chi_square import chi_square
        >>> from dsfit.proposals import UniformSphere
        >>> g = torch.Generator().manual_seed(0)
        >>> found = chi_square(UniformSphere(), dsfit.Context(0.0), 2000, (6, 6), generator=g)
        >>> found.p_value > 0.01, round(found.mass, 6)
        (True, 1.0)
    """
    if context.batch_shape != ():
        raise InputError("context", tuple(context.batch_shape), "a single context, of batch shape ()")
    if samples < 100:
        raise InputError("samples", samples, "at least 100")
    with torch.no_grad():
        distribution = proposal(context)

        def draw(count: int) -> Tensor:
            u = uniforms((count,), distribution.dimension, generator=generator, dtype=context.dtype)
            return distribution.sample(u)

        pilot = draw(_PILOT)
        pilot = pilot[_valid(pilot)]
        if len(pilot) < _PILOT // 10:
            return _hopeless(samples)
        grid = adapted_grid(pilot[:, 0], wrap(context.phi_r - pilot[:, 1]), cells)
        observed, invalid = torch.zeros(grid.shape, dtype=torch.int64), 0
        for start in range(0, samples, _AT_ONCE):
            omega = draw(min(_AT_ONCE, samples - start))
            good = _valid(omega)
            invalid += int((~good).sum())
            omega = omega[good]
            observed += grid.count(omega[:, 0], wrap(context.phi_r - omega[:, 1]))
        pilots = [pilot, *_rare_parts(distribution, generator, context.dtype)]
        found = cell_masses(distribution, context, grid, pilots, rtol=rtol)
    mass = float(found.mass.sum())
    expected = found.mass * (float(observed.sum()) / mass) if mass > 0 else found.mass
    p_value, statistic, degrees = pooled_chi_square(observed, expected)
    deviation = torch.sqrt(expected.clamp_min(POOL))
    blur = float((found.error * samples / deviation).max())
    return ChiSquare(
        p_value=0.0 if invalid else p_value,
        statistic=statistic,
        degrees=degrees,
        mass=mass,
        mass_error=float(found.error.sum()),
        invalid=invalid,
        grid=grid,
        observed=observed,
        expected=expected,
        blur=blur,
    )


def _rare_parts(distribution: Distribution, generator: torch.Generator, dtype: torch.dtype) -> list[Tensor]:
    """Directions of a mixture's components that a pilot of the whole hardly sees."""
    if not isinstance(distribution, MixtureDistribution):
        return []
    found = []
    for component, share in zip(distribution.components, distribution.log_weights.exp().unbind(-1), strict=True):
        if float(share) < 40 / _PILOT:
            omega = component.sample(uniforms((256,), component.dimension, generator=generator, dtype=dtype))
            found.append(omega[_valid(omega)])
        found += _rare_parts(component, generator, dtype)
    return [omega for omega in found if len(omega)]


def _valid(omega: Tensor) -> Tensor:
    limit = torch.tensor(HALF_PI, dtype=omega.dtype)
    return omega.isfinite().all(dim=-1) & (omega[..., 0].abs() <= limit)


def _hopeless(samples: int) -> ChiSquare:
    """What to say of a sampler that hardly ever returns a direction."""
    grid = CellGrid(torch.tensor([-HALF_PI, HALF_PI]).double(), torch.tensor([-math.pi, math.pi]).double())
    nothing = torch.zeros(1, 1, dtype=torch.float64)
    return ChiSquare(0.0, math.inf, 0, math.nan, math.nan, samples, grid, nothing, nothing, 0.0)


def run(
    subject: Subject, *, say: Say = silent, samples: int = 100_000, cells: tuple[int, int] = (24, 16)
) -> Outcome:
    """The test for every proposal of the subject: one finding for the cells, one for the total mass.

    Arrays: cells of the least likely proposals, `NAME/observed`, `/expected`, `/theta`, `/phi`.
    """
    outcome, tested = Outcome(), {}
    for k, (name, proposal) in enumerate(subject.proposals.items()):
        say(f"chi-square: {name}")
        generator = torch.Generator().manual_seed(subject.seed + 7919 * k)
        test = chi_square(proposal, subject.context, samples, (cells[0], cells[1]), generator=generator)
        tested[name] = test
        outcome.findings += findings(name, subject.label, test)
    for name in sorted(tested, key=lambda key: tested[key].p_value)[:_SHOWN]:
        test = tested[name]
        for key, value in (
            ("observed", test.observed),
            ("expected", test.expected),
            ("theta", test.grid.theta),
            ("phi", test.grid.phi),
        ):
            outcome.arrays[f"{name}/{key}"] = np.asarray(value.double())
    return outcome


def findings(subject: str, case: str, test: ChiSquare) -> list[Finding]:
    """The two findings of a test."""
    unclear = None
    if test.blur > 0.5:
        unclear = f"expected counts are known to {test.blur:.2g} standard deviations only"
    detail = f"{test.invalid} samples outside the sphere" if test.invalid else f"{test.degrees} degrees of freedom"
    data = {"statistic": test.statistic, "degrees": test.degrees, "mass": test.mass, "invalid": test.invalid}
    gap = abs(test.mass - 1)
    return [
        Finding(SUITE, subject, case, p_value=test.p_value, unclear=unclear, detail=detail, data=data),
        Finding(
            SUITE,
            f"{subject}, mass",
            case,
            value=gap,
            bound=1e-5 + 2 * test.mass_error,
            unclear=f"mass known to {test.mass_error:.1g} only" if test.mass_error > 1e-3 else None,
            detail=f"mass {test.mass:.8f}",
        ),
    ]


__all__ = ["ChiSquare", "chi_square", "findings", "pooled_chi_square", "run"]
