"""Chains on the oracle's |F|, which shares no code with dsfit, against resampling with dsfit's F and densities."""

from __future__ import annotations

import functools
import math
import sys
from pathlib import Path

import numpy as np
import torch
from scipy.interpolate import RectBivariateSpline, make_interp_spline
from torch import Tensor

import dsfit
from dsfit.checks import independent
from dsfit.checks.finding import Finding
from dsfit.checks.independent.findings import findings_of
from dsfit.checks.subject import Subject
from dsfit.frame import HALF_PI
from dsfit.proposals import StructuredProposal, chapter_proposals

sys.path.insert(0, str(Path(__file__).parents[1] / "oracle"))
import oracle_averages  # noqa: E402
import oracle_azimuth  # noqa: E402

DEG = math.pi / 180
THETA_R, D_B, SAMPLES = 0.5, 0.7, 16_384


@functools.cache
def fiber() -> dsfit.Fiber:
    """Brown hair with wide caustics, which a coarse table can hold."""
    return dsfit.Fiber.preset("brown", caustic_width=torch.tensor(30 * DEG, dtype=torch.float64))


@functools.cache
def oracle_size() -> independent.Size:
    """|F| cos(theta_i) of the oracle, directly lit: N_p from a table over theta_diff and phi, averages over theta_i,
    lobes and projections from the formulas (eqs 4-7).
    """
    f = oracle_azimuth.Fiber(
        sigma_a=tuple(fiber().sigma_a.tolist()),
        caustic_width=float(fiber().caustic_width),
    )
    diff = np.linspace(THETA_R / 2 - math.pi / 4, THETA_R / 2 + math.pi / 4, 21)
    phi = np.linspace(0, math.pi, 51)
    table = np.array(
        [[[oracle_azimuth.azimuthal(f, p, d, a, "marschner", 0.0) for a in phi] for d in diff] for p in range(3)]
    )
    tables = [[RectBivariateSpline(diff, phi, table[p, ..., c], kx=3, ky=1) for c in range(3)] for p in range(3)]
    edge = HALF_PI - 0.01  # the oracle's averages need |theta| < pi/2; |F| has a factor cos(theta)
    knots = np.linspace(-edge, edge, 33)
    rows = [oracle_averages.averages(f, t, D_B, oracle_averages.Options(), 16) for t in knots]
    average = {k: make_interp_spline(knots, [getattr(row, k) for row in rows]) for k in ("A_b", "delta_b", "sigma_b")}

    def gauss(x: np.ndarray, width: np.ndarray | float) -> np.ndarray:
        return np.exp(-0.5 * (x / width) ** 2) / (width * math.sqrt(2 * math.pi))

    def size(omega: Tensor) -> Tensor:
        theta_i, azimuth = omega[:, 0].numpy(), np.abs(omega[:, 1].numpy())
        half, diff = (theta_i + THETA_R) / 2, (THETA_R - theta_i) / 2
        lobes = sum(
            gauss(half - f.alpha[p], f.beta[p])[:, None]
            * np.stack([tables[p][c].ev(diff, azimuth) for c in range(3)], axis=-1)
            for p in range(3)
        )
        a_b, delta_b, sigma_b = (average[k](theta_i.clip(-edge, edge)) for k in ("A_b", "delta_b", "sigma_b"))
        back = 2 * a_b * gauss(half[:, None] - delta_b, sigma_b) / math.pi
        value = 0.5 * (lobes + D_B * back) / np.cos(diff)[:, None] ** 2 * np.cos(theta_i)[:, None]
        return torch.from_numpy(np.linalg.norm(value, axis=-1))

    return size


def findings(strand: dsfit.Fiber) -> dict[str, Finding]:
    """Of dsfit with this fibre, against chains on the oracle's brown hair."""
    bsdf = dsfit.DualScattering(strand, d_b=D_B)
    integrand, context = dsfit.Integrand(bsdf), dsfit.Context(THETA_R, 0.0, 0.0, 1.0)
    proposals = {
        "uniform": chapter_proposals(bsdf, learnable=False)["uniform"],
        "structured": StructuredProposal(bsdf, context),
    }
    made = Subject(integrand, context, proposals, "oracle", 5)
    found = independent.check(made, target=oracle_size(), samples=SAMPLES)
    assert found.diagnostics.reasons == ()
    return {f.subject: f for f in findings_of(found, "oracle", SAMPLES)}


def test_the_table_is_the_oracle() -> None:
    """Within what the comparison below resolves, against dsfit pointwise: means of |F| agree to 2e-3."""
    bsdf, context = dsfit.DualScattering(fiber(), d_b=D_B), dsfit.Context(THETA_R, 0.0, 0.0, 1.0)
    g = torch.Generator().manual_seed(2)
    theta = torch.asin(2 * torch.rand(2000, generator=g, dtype=torch.float64) - 1)
    omega = torch.stack([theta, math.pi * (2 * torch.rand(2000, generator=g, dtype=torch.float64) - 1)], dim=-1)
    own, other = independent.size_of(dsfit.Integrand(bsdf), context)(omega), oracle_size()(omega)
    assert float((own - other).abs().sum() / own.sum()) < 2e-3


def test_dsfit_agrees_with_chains_on_the_oracle() -> None:
    for name, finding in findings(fiber()).items():
        assert finding.verdict(1e-4) == "pass", (name, finding)


def test_a_wrong_lobe_does_not() -> None:
    """TT 1.5 degrees off."""
    wrong = fiber().alpha + torch.tensor([0.0, 1.5 * DEG, 0.0], dtype=torch.float64)
    strand = dsfit.Fiber(**{**fiber().parameters(), "alpha": wrong})
    found = findings(strand)
    assert found["chains against quadrature"].p_value < 1e-6
    assert min(found[f"structured: {kind}"].p_value for kind in ("marginals", "means")) < 1e-6
