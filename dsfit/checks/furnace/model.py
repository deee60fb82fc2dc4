"""Findings on the BSDF itself: energy, symmetry, limits."""

from __future__ import annotations

import functools
import math
from collections.abc import Iterator

import numpy as np
import torch
from torch import Tensor

from dsfit.bsdf.attenuation import lobe_energies
from dsfit.bsdf.azimuthal import refractions
from dsfit.bsdf.conventions import Convention
from dsfit.bsdf.dual_scattering import DualScattering
from dsfit.bsdf.fiber import Fiber
from dsfit.checks.finding import Finding
from dsfit.checks.furnace.approach import Approach, linear_approach
from dsfit.checks.furnace.energy import (
    FURNACE_DEG,
    PRINTED_FURNACE,
    azimuthal_energies,
    independent_energies,
    single_furnace,
    single_scattering,
)
from dsfit.checks.furnace.limits import limits
from dsfit.checks.furnace.symmetry import directions, relative_deviation, symmetries
from dsfit.frame import HALF_PI

SUITE = "furnace"
LOBES = ("R", "TT", "TRT")
_DIFF = (0.0, 0.4, 0.95, 1.2, 1.4, 1.55)


def energy_findings(bsdf: DualScattering) -> Iterator[Finding]:
    """Averages, lobes, remainder, and the furnace of single scattering."""
    grid = torch.linspace(-HALF_PI, HALF_PI, 2001, dtype=torch.float64)
    with torch.no_grad():
        average = bsdf.averages(grid)
        front, back = bsdf.lobe_shares(grid)
    total, literal = average.a_f + average.a_b, (front + back).sum(-2)
    worst = math.degrees(float(grid[total.amax(-1).argmax()]))
    yield _finding(
        "a_f + a_b <= 1", "2001 inclinations", float(total.max()), 1.0 + 1e-12,
        f"largest {float(total.max()):.4f} at {worst:.1f} degrees; {float(literal.max()):.4f} before any limit",
    )  # fmt: skip
    yield from _lobe_findings(bsdf)
    yield from _remainder(bsdf)
    for degrees in (0.0, -55.0):
        if not bsdf.fiber.is_round:
            yield Finding(
                SUITE, "a_f, a_b by quadrature of f_s", f"theta_in = {degrees:g}°",
                unclear="round sections only: others need an average over orientations too",
            )  # fmt: skip
            continue
        found = single_scattering(bsdf, math.radians(degrees), 1e-5)
        error = float(found.error.max() / (found.a_f + found.a_b).max())
        yield _finding(
            "a_f, a_b by quadrature of f_s", f"theta_in = {degrees:g}°", found.deviation, 1e-6 + error,
            f"a_f = {found.a_f.tolist()}, a_b = {found.a_b.tolist()}",
        )  # fmt: skip


def _finding(subject: str, case: str, value: float, bound: float | None, detail: str = "") -> Finding:
    return Finding(SUITE, subject, case, value=value, bound=bound, detail=detail)


def _lobe_findings(bsdf: DualScattering) -> Iterator[Finding]:
    diff = torch.tensor(_DIFF, dtype=torch.float64)
    found = azimuthal_energies(bsdf, diff, 0.4)
    scale = found.direct.sum(1)
    bound = 2e-5 if bsdf.precision == "table" else 1e-6
    glint = bsdf.model == "marschner"
    for p, name in enumerate(LOBES):
        gap = ((found.scattered - found.direct)[:, p] / scale).abs().max()
        yield _finding(f"energy of N^G: {name}", "theta_diff 0 to 89°", float(gap), bound, "int N^G dphi = int N dphi")
        gap = ((found.offsets - found.direct)[:, p] / scale).abs().max()
        if p == 2 and glint:
            detail = "information: a glint in place of the caustic has its own energy, by k_G"
            yield _finding(f"energy of N: {name}", "theta_diff 0 to 89°", float(gap), None, detail)
        else:
            detail = "int N dphi = (1/2) int A dh, by other code"
            yield _finding(f"energy of N: {name}", "theta_diff 0 to 89°", float(gap), 1e-6, detail)


def _remainder(bsdf: DualScattering) -> Iterator[Finding]:
    diff = torch.linspace(0.0, 1.56, 40, dtype=torch.float64)
    fiber = bsdf.fiber.replace(sigma_a=[0.0], eccentricity=1.0)
    inside = lobe_energies(refractions(fiber, diff, None), fiber.sigma_a, bsdf.convention.absorption)[..., 0].sum(-1)
    rest = torch.from_numpy(independent_energies(float(fiber.eta), diff.numpy())[..., 3])
    yield _finding(
        "R + TT + TRT + remainder = 1", "lossless", float((inside + rest - 1).abs().max()), 1e-9,
        "int N of three lobes, and mean (1 - F) F^2 for all others",
    )  # fmt: skip


@functools.cache
def known_table() -> tuple[tuple[float, ...], tuple[float, ...], float]:
    """Furnace of the lossless reference fibre with c_M = 1 and 1/2 at `FURNACE_DEG`, from integrals over offsets; and
    the relative difference of a two-dimensional quadrature at 60 degrees."""
    fiber = Fiber.preset("nonabsorbing", sigma_a=[0.0])
    theta = torch.tensor(FURNACE_DEG, dtype=torch.float64) * (math.pi / 180)
    outgoing = DualScattering(fiber, convention=Convention.named("consistent", average_weight="outgoing"))
    energy = sum(x.sum(-2)[:, 0] for x in outgoing.lobe_shares(theta))
    printed = single_furnace(fiber, theta, "printed")[:, 0]
    direct = single_scattering(outgoing, float(theta[3]), 1e-6)
    difference = float((direct.front + direct.back)[0] / energy[3]) - 1
    return tuple(printed.tolist()), tuple(energy.tolist()), abs(difference)


def known_findings() -> Iterator[Finding]:
    """The table that a lossless fibre has to reproduce; the same for every scene, computed once per process."""
    printed, energy, quadrature = known_table()
    wanted = np.array(PRINTED_FURNACE)
    rounding = 0.5e-4
    for name, found, factor in (("1", printed, 1.0), ("1/2", energy, 0.5)):
        yield _finding(
            f"known furnace, c_M = {name}", "lossless reference fibre", float(np.abs(found - wanted * factor).max()),
            rounding * 1.02, "single scattering at " + ", ".join(f"{x:g}" for x in FURNACE_DEG) + " degrees",
        )  # fmt: skip
    yield _finding("known furnace by quadrature", "lossless reference fibre, 60°", quadrature, 2e-6)
    yield _finding(
        "control: printed norm conserves energy", "negative control", _over(1e-6, max(printed) - 1), 1e-6,
        f"rejected: c_M = 1 reflects {max(printed):.3f} of what arrives",
    )  # fmt: skip


def _over(bound: float, deviation: float) -> float:
    """bound / deviation: small where a control misses by far."""
    return bound / deviation if deviation > 0 else math.inf


def symmetry_findings(bsdf: DualScattering, generator: torch.Generator) -> Iterator[Finding]:
    """Three symmetries that must hold, four that need not, and a control."""
    found = symmetries(bsdf, generator=generator)
    bound = 1e-9
    yield _finding("reciprocity of f_s", "2000 directions", found.exchange, bound, "phi_h kept, phi -> -phi")
    yield _finding("mirror of f_s", "2000 directions", found.mirror, bound, "theta -> -theta with alpha -> -alpha")
    yield _finding("axes of the section", "2000 directions", found.section, bound, "phi_h + pi; -phi_h with -phi")
    for name, value, why in (
        ("mirror with the same tilt", found.tilt, "zero only for alpha = 0"),
        ("section turned by 90°", found.orientation, "zero only for a round section"),
        ("exchange in f_back", found.back, "averages are taken at the light's inclination"),
        ("exchange in F_scatter", found.scatter, "averages are taken at the light's inclination"),
    ):
        yield _finding(f"asymmetry: {name}", "2000 directions", value, None, "information: " + why)
    theta_i, theta_r, phi, phi_h = directions(500, generator)
    with torch.no_grad():
        there = bsdf.single(theta_i, theta_r, phi, phi_h=phi_h) * torch.cos(theta_i)[:, None]
        back = bsdf.single(theta_r, theta_i, -phi, phi_h=phi_h) * torch.cos(theta_r)[:, None]
    deviation = relative_deviation(there, back)
    yield _finding(
        "control: f_s cos(theta_i) is reciprocal", "negative control", _over(bound, deviation), 1e-6,
        f"rejected: differs by {deviation:.2g}",
    )  # fmt: skip


def limit_findings(bsdf: DualScattering, generator: torch.Generator) -> Iterator[Finding]:
    """Bound and order of every limit, v = 1 against n = 0, and a wrong limit that both reject."""
    for found in limits(bsdf, generator=generator):
        yield from _limit(found)
    theta_i, theta_r, phi, phi_h = directions(200, generator, 1.3)
    convention = bsdf.convention
    with torch.no_grad():
        if convention.share == "complement" and convention.back_width == "scatter":
            clear = bsdf(theta_i, theta_r, phi, 0.0, phi_h=phi_h)
            lit = bsdf(theta_i, theta_r, phi, 5.0, 1.0, phi_h=phi_h)
            gap = relative_deviation(clear, lit)
            yield _finding("v = 1 is n = 0", "200 directions", gap, 1e-12, "all light direct, whatever is in the way")
        direct: Tensor = bsdf.direct(theta_i, theta_r, phi, phi_h=phi_h)
    wrong = linear_approach(
        "F_direct", lambda n: bsdf.scatter(theta_i, theta_r, phi, n, phi_h=phi_h), direct, "linear in n"
    )
    yield _finding(
        "control: F_scatter tends to F_direct", "negative control", abs(wrong.measured_order), 0.1,
        f"rejected: order {wrong.measured_order:.3f} instead of 1, {wrong.excess:.2g} times the bound",
    )  # fmt: skip


def _limit(found: Approach) -> Iterator[Finding]:
    shown = ", ".join(f"{d:.1e}" for d in found.distances)
    data = {"parameters": list(found.parameters), "distances": list(found.distances), "bounds": list(found.bounds)}
    yield Finding(
        SUITE, f"limit {found.name}", "bound", value=found.excess, bound=1.0, detail=f"{found.law}: {shown}", data=data
    )
    if found.order:
        yield Finding(
            SUITE, f"limit {found.name}", "order", value=found.shortfall, bound=0.0,
            detail=f"order {found.measured_order:.3f}, at least {found.order:g}",
        )  # fmt: skip
