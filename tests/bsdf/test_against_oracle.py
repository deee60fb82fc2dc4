"""dsfit's BSDF against tests/oracle/reference_values.json (independent oracle): 1e-9 in float64, 1e-5 in float32.

Quantities and inputs are described in tests/oracle/make_reference_values.py. Errors are relative to the value or, where
it is small, to the size of the quantity: its largest value over phi for azimuthal functions, the sum of its terms at
the peak of their Gaussians for F. Two allowances follow from conditioning: F contains a_f^n, hence 1e-11 n more in
float64; and float32 skips raw lobes within 0.02 rad of a caustic or support edge, where rounding of the inputs alone
moves N_p by more. A DualScattering tabulates its averages in about a second, so the default run takes a selection of
fibres, models and precisions; `-m slow` takes the rest.
"""

from __future__ import annotations

import json
from functools import cache
from pathlib import Path

import pytest
import torch
from torch import Tensor

import dsfit

DATA = json.loads((Path(__file__).parents[1] / "oracle" / "reference_values.json").read_text())
FIBERS = tuple(DATA["fibers"])
PRESETS = ("nonabsorbing", "blond", "brown", "black")
MODELS = ("marschner", "raw", "simplified")
ANGLES = ("alpha_f", "alpha_b", "delta_b")
AVERAGES = ("a_f", "a_b", *ANGLES, "beta_f", "beta_b", "A_b", "sigma_b")
DTYPES = pytest.mark.parametrize("dtype", [torch.float64, torch.float32], ids=["float64", "float32"])
SLOW = pytest.mark.slow


def cases(*quick: tuple[str, ...], slow: list[tuple[str, ...]]) -> list:
    """Parameters: the quick ones first, then those of slow that are not among them, marked."""
    return [*quick, *(pytest.param(*case, marks=SLOW) for case in slow if case not in quick)]


EVERY = [(name, model) for name in FIBERS for model in MODELS]
MARSCHNER = [(name, "marschner") for name in FIBERS]


@cache
def make_bsdf(
    name: str, dtype: torch.dtype, model: str = "marschner", convention: str | dsfit.Convention = "consistent"
) -> dsfit.DualScattering:
    parameters = DATA["fibers"][name]["parameters"]
    fiber = dsfit.Fiber(**{key: torch.tensor(value, dtype=dtype) for key, value in parameters.items()})
    return dsfit.DualScattering(fiber, d_f=DATA["d_f"], d_b=DATA["d_b"], azimuthal=model, convention=convention)


def column(name: str, *path: str) -> Tensor:
    """One quantity of all points of a fibre, stacked along the first dimension, float64."""
    rows = []
    for point in DATA["fibers"][name]["points"]:
        for key in path:
            point = point[key]
        rows.append(point)
    return torch.tensor(rows, dtype=torch.float64)


def inputs(name: str, dtype: torch.dtype, *keys: str) -> list[Tensor]:
    return [column(name, key).to(dtype) for key in keys]


def elliptic(name: str, dtype: torch.dtype) -> dict[str, Tensor]:
    """phi_h as a keyword where the fibre needs it."""
    return {"phi_h": column(name, "phi_h").to(dtype)} if name == "elliptic" else {}


def check(
    found: Tensor, expected: Tensor, size: Tensor, rtol: Tensor | float = 0.0, keep: Tensor | None = None
) -> None:
    """|found - expected| within 1e-9 of max(|expected|, 1e-3 size) (float64), or 1e-5 of max(|expected|, 1e-2 size).

    float32: 1e-7 of the size is its rounding, so no tail below that can be asked for. rtol adds to the 1e-9 of float64;
    keep selects rows.
    """
    assert found.shape == expected.shape
    double = found.dtype == torch.float64
    unit, floor = (1e-9 + rtol, 1e-3) if double else (1e-5, 1e-2)
    allowed = unit * torch.maximum(expected.abs(), floor * size) + torch.finfo(found.dtype).tiny
    found = found.double()
    excess = torch.where(torch.isfinite(found), (found - expected).abs() / allowed, torch.inf)
    if keep is not None:
        found, expected, excess = found[keep], expected[keep], excess[keep]
    bad = excess > 1.0
    if bool(bad.any()):
        worst = excess.argmax()
        pytest.fail(
            f"{int(bad.sum())} of {bad.numel()} off, worst {float(excess.max()):.3g} x tolerance: "
            f"found {float(found.flatten()[worst])!r}, expected {float(expected.flatten()[worst])!r}; "
            f"at {bad.nonzero()[:8].tolist()}"
        )


def check_averages(found: dsfit.Averages, expected: dict[str, Tensor]) -> None:
    """All averages; angles can cancel and are measured against their largest value over points and channels.

    A_b and Delta_b have a pole at a_f = 1, crossed only without the energy limit: 1e-9 in a_f means 1e-9 / |1 - a_f|.
    """
    for field in AVERAGES:
        value = expected[field]
        size = 1e3 * value.abs().max() if field in ANGLES else 0.0
        near_pole = field in ("A_b", "delta_b") and bool((expected["a_f"] > 1.0).any())
        rtol = 1e-9 / (1.0 - expected["a_f"]).abs() if near_pole else 0.0
        check(getattr(found, field), value, size * torch.ones_like(value), rtol)


def away_from_edges(name: str, model: str, dtype: torch.dtype) -> Tensor | None:
    return column(name, "margin") > 0.02 if model == "raw" and dtype == torch.float32 else None


@DTYPES
@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize("name", FIBERS)
def test_azimuthal(name: str, model: str, dtype: torch.dtype) -> None:
    bsdf = make_bsdf(name, dtype, model)
    found = bsdf.azimuthal(*inputs(name, dtype, "theta_diff", "phi"), **elliptic(name, dtype))
    assert found.dtype == dtype
    expected = column(name, "azimuthal", model)
    check(found, expected, column(name, "size_azimuthal"), keep=away_from_edges(name, model, dtype))


@DTYPES
@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize("name", FIBERS)
def test_azimuthal_scattered(name: str, model: str, dtype: torch.dtype) -> None:
    bsdf = make_bsdf(name, dtype, model)
    found = bsdf.azimuthal_scattered(*inputs(name, dtype, "theta_diff", "phi"), **elliptic(name, dtype))
    check(found, column(name, "scattered", model), column(name, "size_scattered"))


@pytest.mark.parametrize("name", FIBERS)
def test_averages(name: str) -> None:
    found = make_bsdf(name, torch.float64).averages(*inputs(name, torch.float64, "theta_i"))
    check_averages(found, {field: column(name, "averages", field) for field in AVERAGES})


@pytest.mark.parametrize("name", ["brown", *(pytest.param(n, marks=SLOW) for n in FIBERS if n != "brown")])
def test_averages_in_float32(name: str) -> None:
    found = make_bsdf(name, torch.float32).averages(*inputs(name, torch.float32, "theta_i"))
    assert found.a_f.dtype == torch.float32
    check_averages(found, {field: column(name, "averages", field) for field in AVERAGES})


@pytest.mark.parametrize("name", [pytest.param(n, marks=SLOW) if n == "elliptic" else n for n in FIBERS])
def test_averages_of_the_printed_convention(name: str) -> None:
    found = make_bsdf(name, torch.float64, convention="printed").averages(*inputs(name, torch.float64, "theta_diff"))
    check_averages(found, {field: column(name, "averages_printed", field) for field in AVERAGES})


def check_consistent(name: str, model: str, dtype: torch.dtype) -> None:
    arguments = inputs(name, dtype, "theta_i", "theta_r", "phi", "n", "v")
    found = make_bsdf(name, dtype, model)(*arguments, **elliptic(name, dtype))
    expected, size = column(name, "consistent", model), column(name, "size", model)
    check(found, expected, size, 1e-11 * arguments[3].double()[:, None], away_from_edges(name, model, dtype))


@pytest.mark.parametrize("name, model", cases(*MARSCHNER, ("blond", "raw"), ("narrow", "simplified"), slow=EVERY))
def test_consistent(name: str, model: str) -> None:
    check_consistent(name, model, torch.float64)


@pytest.mark.parametrize("name, model", cases(("brown", "marschner"), ("narrow", "marschner"), slow=EVERY))
def test_consistent_in_float32(name: str, model: str) -> None:
    check_consistent(name, model, torch.float32)


PRINTED = [pair for pair in EVERY if pair[1] != "raw"]


@pytest.mark.parametrize(
    "name, model",
    cases(*(pair for pair in MARSCHNER if pair[0] != "elliptic"), ("blond", "simplified"), slow=PRINTED),
)
def test_printed(name: str, model: str) -> None:
    """float64 only: a_f > 1 overflows float32 at large n. Terms of both signs cancel: errors are relative to size."""
    arguments = inputs(name, torch.float64, "theta_i", "theta_r", "phi", "n", "v")
    found = make_bsdf(name, torch.float64, model, "printed")(*arguments, **elliptic(name, torch.float64))
    size = column(name, "size_printed", model)
    check(found, column(name, "printed", model), 1e3 * size, 1e-11 * arguments[3][:, None])


SWITCHES = list(dict.fromkeys(tuple(*row["switch"].items()) for row in DATA["switches"]))


def switch_cases() -> list:
    """Quick: blond, with the model that the switch changes most."""
    every = [
        (name, model, *switch)
        for switch in SWITCHES
        for name in ("blond", "dense")
        for model in ("marschner", "simplified")
    ]
    quick = [
        ("blond", "simplified" if switch[0] == "simplified_energy" else "marschner", *switch) for switch in SWITCHES
    ]
    return cases(*quick, slow=every)


@pytest.mark.parametrize("name, model, switch, value", switch_cases())
def test_single_switches(name: str, model: str, switch: str, value: object) -> None:
    """`consistent` with one switch changed: its averages and F, which can have terms of both signs."""
    rows = [row for row in DATA["switches"] if row["fiber"] == name and row["switch"] == {switch: value}]
    assert len(rows) == 3

    def stack(*path: str) -> Tensor:
        return torch.tensor(
            [row[path[0]][path[1]] if len(path) > 1 else row[path[0]] for row in rows], dtype=torch.float64
        )

    bsdf = make_bsdf(name, torch.float64, model, dsfit.Convention(**{switch: value}))
    arguments = [stack(key) for key in ("theta_i", "theta_r", "phi", "n", "v")]
    check(bsdf(*arguments), stack(model), 1e3 * stack(model + "_size"))
    check_averages(bsdf.averages(arguments[0]), {field: stack("averages", field) for field in AVERAGES})


@pytest.mark.parametrize("name", PRESETS)
def test_presets_are_the_fibers_of_the_oracle(name: str) -> None:
    preset = dsfit.Fiber.preset(name)
    for field, expected in DATA["fibers"][name]["parameters"].items():
        value = torch.as_tensor(getattr(preset, field), dtype=torch.float64)
        torch.testing.assert_close(value, torch.tensor(expected, dtype=torch.float64), rtol=1e-15, atol=0.0)


def test_v_left_out_is_lit_without_fibers_in_front() -> None:
    bsdf = make_bsdf("blond", torch.float64)
    theta_i, theta_r, phi, n = inputs("blond", torch.float64, "theta_i", "theta_r", "phi", "n")
    torch.testing.assert_close(bsdf(theta_i, theta_r, phi, n), bsdf(theta_i, theta_r, phi, n, (n == 0).to(n.dtype)))
