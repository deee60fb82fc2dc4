"""Energy, symmetries, limits and single samples: the library passes, deliberate errors do not."""

from __future__ import annotations

import dataclasses
import functools
import math

import numpy as np
import pytest
import torch
from torch import Tensor

import dsfit
from dsfit.checks.furnace import (
    Partition,
    approach,
    azimuthal_energies,
    draw,
    independent_energies,
    limits,
    linear_approach,
    material_consistency,
    partition_nodes,
    sample_weights,
    single_furnace,
    single_scattering,
    symmetries,
)
from dsfit.checks.furnace.energy import FURNACE_DEG
from dsfit.checks.furnace.limits import scattering_limits
from dsfit.checks.furnace.model import energy_findings, known_findings, known_table, symmetry_findings
from dsfit.proposals import UniformSphere

DEG = math.pi / 180
CONTEXT = dsfit.Context(0.4, 0.7)


@functools.cache
def bsdf(convention: str = "consistent", eccentricity: float = 1.0) -> dsfit.DualScattering:
    fiber = dsfit.Fiber.preset("blond", sigma_a=[0.07], eccentricity=eccentricity)
    return dsfit.DualScattering(fiber, convention=convention)


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def test_attenuation_adds_up_to_one() -> None:
    """Energies of R, TT, TRT at six inclinations to the printed digits; with the remainder, everything."""
    found = independent_energies(1.55, np.radians([0, 30, 45, 60, 75, 89]))
    table = [[0.0750, 0.8618, 0.0557], [0.0862, 0.8428, 0.0614], [0.1098, 0.8026, 0.0736],
             [0.1735, 0.6974, 0.1020], [0.3602, 0.4250, 0.1367], [0.9250, 0.0061, 0.0056]]  # fmt: skip
    assert np.abs(found[:, :3] - np.array(table)).max() < 1.1e-4
    assert np.abs(found.sum(-1) - 1).max() < 1e-14


def test_known_furnace_of_the_lossless_fibre() -> None:
    printed, energy, quadrature = known_table()
    wanted = np.array([1.9008, 2.0227, 2.0803, 2.1006, 2.0432, 1.8844, 1.8069, 1.9353])
    assert np.abs(np.array(printed) - wanted).max() < 0.51e-4
    assert np.abs(np.array(energy) - wanted / 2).max() < 0.26e-4
    assert quadrature < 2e-6
    theta = torch.tensor(FURNACE_DEG, dtype=torch.float64) * DEG
    narrow = dsfit.Fiber.preset("nonabsorbing", sigma_a=[0.0], alpha=[0.0] * 3, beta=[0.1 * DEG, 0.05 * DEG, 0.2 * DEG])
    found = single_furnace(narrow, theta)[:, 0].numpy()
    assert np.abs(found - [0.9924, 0.9904, 0.9860, 0.9728, 0.9471, 0.8857, 0.8591, 0.9271]).max() < 0.51e-4
    assert all(finding.verdict(0.01) == "pass" for finding in known_findings())


@pytest.mark.parametrize("model", ["marschner", "raw", "simplified"])
def test_lobes_keep_their_energy(model: str) -> None:
    diff = torch.tensor([0.0, 0.5, 0.95, 1.4], dtype=torch.float64)
    for eccentricity in (1.0, 0.9):
        found = azimuthal_energies(bsdf(eccentricity=eccentricity).replace(azimuthal=model), diff, 0.4)
        scale = found.direct.sum(1, keepdim=True)
        assert float(((found.scattered - found.direct) / scale).abs().max()) < 1e-9
        free = slice(0, 2) if model == "marschner" else slice(0, 3)
        assert float(((found.offsets - found.direct) / scale)[:, free].abs().max()) < 1e-9
    # control: N^G as a constant, the printed slice at phi = 0, keeps nothing
    constant = bsdf().replace(convention=dsfit.Convention.named("consistent", scattered_azimuth="constant"))
    wrong = azimuthal_energies(constant, diff)
    assert float(((wrong.scattered - wrong.direct) / wrong.direct.sum(1, keepdim=True)).abs().max()) > 0.1


def test_averages_are_the_quadrature_of_single_scattering() -> None:
    found = single_scattering(bsdf(), -55 * DEG, 1e-5)
    assert found.deviation < 1e-6 + float(found.error.max())
    # control: the averages of another split of the azimuth
    split = dataclasses.replace(found, a_f=found.a_f * 1.001)
    assert split.deviation > 1e-4
    with pytest.raises(ValueError, match="round"):
        single_scattering(bsdf(eccentricity=0.9), 0.0)


def test_printed_norm_is_refused() -> None:
    fiber = dsfit.Fiber.preset("nonabsorbing", sigma_a=[0.0])
    printed = dsfit.DualScattering(fiber, convention=dsfit.Convention.named("consistent", lobe_norm="printed",
                                                                              limit_energy=False))  # fmt: skip
    energy = next(energy_findings(printed))
    assert energy.subject == "a_f + a_b <= 1" and energy.verdict(0.01) == "fail" and energy.value > 1.8


def test_symmetries() -> None:
    plain, bent = symmetries(bsdf(), generator=generator()), symmetries(bsdf(eccentricity=0.9), generator=generator())
    for found in (plain, bent):
        assert max(found.exchange, found.mirror, found.section) < 1e-9
        assert min(found.tilt, found.back, found.scatter) > 0.5  # measured, and far from symmetric
    assert plain.orientation == 0.0 and bent.orientation > 0.1
    upright = bsdf().replace(fiber=bsdf().fiber.replace(alpha=[0.0, 0.0, 0.0]))
    assert symmetries(upright, generator=generator()).tilt < 1e-9
    assert all(f.verdict(0.01) == "pass" for f in symmetry_findings(bsdf(), generator()))

    class Lopsided(dsfit.DualScattering):
        def single(self, theta_i: Tensor, theta_r: Tensor, phi: Tensor, *, phi_h: Tensor | None = None) -> Tensor:
            return super().single(theta_i, theta_r, phi, phi_h=phi_h) * (1 + 1e-6 * theta_i[:, None])

    assert symmetries(Lopsided(bsdf().fiber), generator=generator()).exchange > 1e-7


@pytest.mark.parametrize(("convention", "eccentricity"), [("consistent", 1.0), ("consistent", 0.9)])
def test_limits_are_approached_at_their_rate(convention: str, eccentricity: float) -> None:
    for found in limits(bsdf(convention, eccentricity), generator=generator(1)):
        assert found.excess <= 1.0, found
        assert found.shortfall <= 0.0, found


def test_growing_transmittance_breaks_its_limit() -> None:
    """With the printed norm a_f exceeds 1, and a_f^n grows without bound."""
    found = {x.name: x for x in scattering_limits(bsdf("printed"), generator(1))}
    assert found["n to inf: a_f^n"].excess > 1e3


def test_wrong_limits_are_refused() -> None:
    steps = (1e-1, 1e-2, 1e-3, 1e-4)
    limit = torch.tensor([1.0, 2.0], dtype=torch.float64)

    def check(function, bound=lambda x: 3 * x):  # noqa: ANN001, ANN202
        return approach("toy", function, limit, steps, bound, 0.9, "linear")

    assert check(lambda x: limit + x).excess <= 1 and check(lambda x: limit + x).shortfall <= 0
    assert check(lambda x: limit + x + 2e-4).shortfall > 0.1  # wrong by a constant that is small at every step
    assert check(lambda x: limit + x**0.5).shortfall > 0.3 and check(lambda x: limit + x**0.5).excess > 1
    assert check(lambda x: limit / 0).excess == math.inf
    assert check(lambda x: limit).measured_order == math.inf and check(lambda x: limit).excess <= 1
    assert linear_approach("toy", lambda x: 1.1 * limit + x, limit, "linear").shortfall > 0.8


def test_single_samples() -> None:
    integrand = dsfit.Integrand(bsdf().replace(d_b=0.0))
    draws = draw(integrand, UniformSphere(), CONTEXT, 500, generator=generator(2), beside=0.3)
    found = sample_weights(draws)
    assert found.faults == 0 and found.log_gap == 0.0 and found.largest > 1
    k = int(draws.own.nonzero()[0])

    def spoiled(field: str, value: float) -> Tensor:
        changed = getattr(draws, field).clone()
        changed[k] = value
        return changed

    for field, value, fault in (
        ("value", -1.0, "bad_values"), ("value", math.nan, "bad_values"), ("log_returned", -math.inf, "zero_density"),
        ("log_evaluated", math.nan, "zero_density"), ("log_returned", -1e4, "bad_weights"),
    ):  # fmt: skip
        wrong = dataclasses.replace(draws, **{field: spoiled(field, value)})
        if fault == "bad_weights":
            wrong = dataclasses.replace(wrong, value=spoiled("value", 1.0), log_evaluated=wrong.log_returned)
        assert getattr(sample_weights(wrong), fault) == 1, (field, value)
        assert sample_weights(wrong).faults == (fault != "bad_values"), (field, value)
    apart = dataclasses.replace(draws, log_returned=spoiled("log_returned", float(draws.log_returned[k]) + 1e-3))
    assert sample_weights(apart).log_gap > 5e-4


class WithoutQuotient(dsfit.Material):
    """Returns F cos(theta_i), which PBRT multiplies by |n . wi| again."""

    def f(self, wo: Tensor, wi: Tensor) -> Tensor:
        return self.f_cos(wo, wi)

    def sample_f(self, wo: Tensor, u: Tensor):  # noqa: ANN201
        drawn = super().sample_f(wo, u)
        return drawn._replace(f=self.f(wo, drawn.wi))


class OtherDensity(dsfit.Material):
    """pdf of other directions than sample_f's."""

    def pdf(self, wo: Tensor, wi: Tensor) -> Tensor:
        return super().pdf(wo, wi * torch.tensor([-1.0, 1.0, 1.0]).double())


def test_material_keeps_pbrts_convention() -> None:
    single = bsdf().replace(d_b=0.0)
    integrand, proposal = dsfit.Integrand(single), dsfit.StructuredProposal(single, CONTEXT)
    nodes = partition_nodes(integrand, CONTEXT, Partition.even(6))
    expected = nodes.integrate(lambda rule: rule.value)[0].sum(0)
    omega = nodes.fine.omega[::40]
    u = torch.rand(6000, proposal(CONTEXT).dimension, generator=generator(3), dtype=torch.float64)
    found = {
        kind.__name__: material_consistency(kind(single, proposal), integrand, CONTEXT, u, omega, expected)
        for kind in (dsfit.Material, WithoutQuotient, OtherDensity)
    }
    assert found["Material"].deviation < 1e-9 and float(found["Material"].z.abs().max()) < 4
    assert float((found["Material"].standard_error / expected).max()) < 0.01
    assert found["WithoutQuotient"].convention > 0.1 and float(found["WithoutQuotient"].z.abs().max()) > 6
    assert found["OtherDensity"].sampled_pdf > 0.1
