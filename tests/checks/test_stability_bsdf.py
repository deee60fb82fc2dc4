"""The atlas' entries of the BSDF: within their limits, and able to tell a wrong function from a right one."""

from __future__ import annotations

import dataclasses

import pytest
import torch
from mpmath import mp

from dsfit.checks.stability import exact_bsdf as exact
from dsfit.checks.stability import exact_bsdf_averages as averages
from dsfit.checks.stability import exact_bsdf_scattered as scattered
from dsfit.checks.stability.bsdf import FUNCTIONS
from dsfit.checks.stability.function import Function
from dsfit.checks.stability.measure import DTYPES, Measurement, measure

ENTRIES = {function.name: function for function in FUNCTIONS}
SLOW = ("F ", "N^G_", "bsdf.N_TRT", "a_f", "a_b", "alpha_", "beta_", "of a fibre")
QUICK = [name for name in ENTRIES if not any(part in name for part in SLOW) or name == "bsdf.a_f^n"]


def _within(function: Function, regime: str) -> list[Measurement]:
    found = []
    for dtype in DTYPES:
        measured = measure(function, regime, dtype)
        value, gradient = function.limit(regime, dtype)
        assert measured.value.worst <= value, (regime, dtype, measured.value)
        for errors in (measured.gradient, measured.forward):
            assert errors is None or errors.worst <= gradient, (regime, dtype, errors)
        found.append(measured)
    return found


@pytest.mark.parametrize("name", QUICK)
def test_quick_entries_are_within_their_limits(name: str) -> None:
    """Every regime of what takes a second."""
    for regime in ENTRIES[name].regimes:
        _within(ENTRIES[name], regime)


@pytest.mark.parametrize(
    "name, regime",
    [
        ("bsdf.N_TRT", "caustic: 0.01 and 0.001 beside it"),
        ("bsdf.N^G_R", "caustic: phi at 0, pi/2 and pi"),
        ("bsdf.N^G_TRT", "narrow: glints of 0.1 to 1.5 deg"),
        ("bsdf.a_f", "grazing: 89.999 deg"),
        ("bsdf.F direct", "ordinary"),
    ],
)
def test_telling_regimes_of_slow_entries(name: str, regime: str) -> None:
    """One regime each of what takes longer: those in which the library was once wrong."""
    _within(ENTRIES[name], regime)


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in ENTRIES if name not in QUICK])
def test_slow_entries_are_within_their_limits(name: str) -> None:
    for regime in ENTRIES[name].regimes:
        _within(ENTRIES[name], regime)


@pytest.mark.parametrize(
    "name, regime, dtype, least",
    [
        ("bsdf.fresnel", "ordinary", "float64", 1e-2),  # total reflection that there is not
        ("bsdf.fresnel transmittance", "grazing: offset near 1", "float32", 0.1),
        ("bsdf.N_TRT raw", "switch: eta' = 2 -+ 1e-12 to 0.01", "float64", 0.1),  # Cardano's cubic
        ("bsdf.A_b", "clear: a_f + a_b = 1, a_f near 1", "float64", 1e-12),
        ("bsdf.sigma_b", "clear: a_b to 0", "float64", 1.0),  # 0/0
    ],
)
def test_naive_formulas_are_caught(name: str, regime: str, dtype: str, least: float) -> None:
    function = ENTRIES[name]
    found = measure(function, regime, dtype)
    assert found.naive is not None and found.naive.worst > max(least, 10 * function.limit(regime, dtype)[0])


def test_a_wrong_function_is_caught() -> None:
    """A relative error of 1e-10 in the value, and a derivative that misses a term, exceed the limits."""
    right = ENTRIES["bsdf.N_TT"]
    off = dataclasses.replace(right, compute=lambda *x: right.compute(*x) * (1 + 1e-10))
    assert measure(off, "ordinary", "float64").value.worst > right.limit("ordinary", "float64")[0]
    frozen = dataclasses.replace(right, compute=lambda *x: right.compute(*x[:-1], x[-1].detach()))
    gradient = measure(frozen, "ordinary", "float64").gradient
    assert gradient is not None and gradient.worst > 0.1


def test_twins_of_the_lobes_agree_with_each_other() -> None:
    """int N_p dphi = (1/2) int A dh, and N^G over both half circles adds up to it, of independent twins."""
    with mp.workdps(40):
        hair = exact.Hair(mp.mpf("1.5"), mp.mpf("0.125"))
        diff, phi = mp.mpf("0.3"), mp.mpf("0.6")
        for p in range(3):
            whole = scattered.energy(p, hair, diff)
            halves = scattered.window(p, hair, diff, phi) + scattered.window(p, hair, diff, phi - mp.pi)
            assert abs(mp.pi * halves / whole - 1) < mp.mpf(10) ** -18
        direct = mp.quad(lambda x: exact.lobe(0, hair, diff, x), [-mp.pi, 0, mp.pi])
        assert abs(direct / scattered.energy(0, hair, diff) - 1) < mp.mpf(10) ** -20


def test_twin_of_the_averages_has_converged(monkeypatch: pytest.MonkeyPatch) -> None:
    """More nodes change a_f by less than 1e-15."""
    coat = averages.Coat(exact.Hair(mp.mpf("1.5"), mp.mpf("0.125")), (-0.125, 0.0625, 0.1875), (0.125, 0.0625, 0.25))
    coarse = averages.averages(coat, mp.mpf("0.3"))
    averages.averages.cache_clear()
    averages.energies_of.cache_clear()
    for name, more in (("_DEGREE", 28), ("_OFFSETS", 15), ("_INCLINATIONS", 20)):
        monkeypatch.setattr(averages, name, more)
    fine = averages.averages(coat, mp.mpf("0.3"))
    averages.averages.cache_clear()
    averages.energies_of.cache_clear()
    for field in dataclasses.fields(averages.Averages):
        assert abs(getattr(coarse, field.name) / getattr(fine, field.name) - 1) < mp.mpf(10) ** -15, field.name


def test_every_regime_has_points_in_both_dtypes() -> None:
    for function in FUNCTIONS:
        for regime, points in function.regimes.items():
            assert points and all(len(point) == len(function.arguments) for point in points), (function.name, regime)
            columns = torch.tensor(points, dtype=torch.float32)
            assert bool(columns.isfinite().all()), (function.name, regime)
