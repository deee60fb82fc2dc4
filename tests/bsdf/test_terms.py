"""Terms of F: what is named is computed, what is not is left out, exactly."""

from __future__ import annotations

import itertools

import pytest
import torch
from torch import Tensor

import dsfit
from dsfit.bsdf.terms import TERMS, Terms

F64 = torch.float64


def directions(count: int = 60) -> tuple[Tensor, Tensor, Tensor]:
    g = torch.Generator().manual_seed(3)
    x = torch.rand(3, count, generator=g, dtype=F64)
    return (x[0] - 0.5) * 3.1, (x[1] - 0.5) * 3.1, (x[2] - 0.5) * 6.2


@pytest.mark.parametrize("precision", ["exact", "table"])
def test_terms_add_up(precision: str) -> None:
    """F is the sum of its eight terms, each computed alone."""
    bsdf = dsfit.DualScattering(dsfit.Fiber.preset("blond"), precision=precision)
    theta_i, theta_r, phi = directions()
    total: Tensor | float = 0.0
    for half, name in itertools.product(("direct", "scattered"), TERMS):
        only = bsdf.replace(terms=Terms(**{"direct": (), "scattered": (), half: (name,)}))
        part = only(theta_i, theta_r, phi, 2.0, 0.3)
        assert bool((part >= -1e-6).all()) and bool((part > 0).any())
        total = total + part
    torch.testing.assert_close(total, bsdf(theta_i, theta_r, phi, 2.0, 0.3), rtol=1e-12, atol=1e-15)


@pytest.mark.parametrize("model", ["marschner", "raw", "simplified"])
@pytest.mark.parametrize("which", [("R",), ("TT", "TRT"), ("R", "TRT")])
def test_some_lobes_are_those_of_all(model: str, which: tuple[str, ...]) -> None:
    """A lobe has the same value alone and in company, to the last bit, in every azimuthal model."""
    bsdf = dsfit.DualScattering(dsfit.Fiber.preset("brown"), azimuthal=model)
    _, diff, phi = directions()
    lobes = tuple(TERMS.index(name) for name in which)
    for function in (bsdf.azimuthal, bsdf.azimuthal_scattered):
        torch.testing.assert_close(
            function(diff / 2, phi, lobes=lobes), function(diff / 2, phi)[..., list(lobes), :], rtol=0, atol=0
        )


def test_printed_shapes_by_lobe() -> None:
    """The printed azimuths and the constant N^G too give the lobes that are asked for."""
    bsdf = dsfit.DualScattering(dsfit.Fiber.preset("brown"), azimuthal="simplified", convention="printed")
    _, diff, phi = directions()
    for function in (bsdf.azimuthal, bsdf.azimuthal_scattered):
        torch.testing.assert_close(function(diff, phi, lobes=(1,)), function(diff, phi)[..., 1:2, :], rtol=0, atol=0)


def test_without_glint() -> None:
    """The direct TRT is the raw one; a table of N^G is what it was."""
    fiber = dsfit.Fiber.preset("blond")
    theta_i, theta_r, phi = directions()
    plain = dsfit.DualScattering(fiber).replace(terms=Terms(glint=False))
    raw = dsfit.DualScattering(fiber, azimuthal="raw")
    torch.testing.assert_close(plain(theta_i, theta_r, phi, 2.0, 0.3), raw(theta_i, theta_r, phi, 2.0, 0.3))
    table = dsfit.DualScattering(fiber, precision="table")
    other = table.replace(terms=Terms(glint=False))
    a, b = (x.azimuthal_scattered(theta_i / 2, phi) for x in (table, other))
    torch.testing.assert_close(a, b, rtol=0, atol=0)


@pytest.mark.parametrize("precision", ["exact", pytest.param("table", marks=pytest.mark.slow)])
def test_grey(precision: str) -> None:
    """One channel stands for all: F, averages, shares and azimuths keep their shape and value to 1e-15."""
    fiber = dsfit.Fiber.preset("blond", sigma_a=torch.tensor([0.1, 0.1, 0.1], dtype=F64))
    full = dsfit.DualScattering(fiber, precision=precision)
    grey = full.replace(terms=Terms(grey=True))
    theta_i, theta_r, phi = directions()
    assert grey.channels == 3

    def results(x: dsfit.DualScattering) -> tuple[Tensor, ...]:
        return x(theta_i, theta_r, phi, 2.0, 0.3), x.azimuthal(theta_i, phi), *x.lobe_shares(theta_i)

    for a, b in zip(results(full), results(grey), strict=True):
        assert a.shape == b.shape
        torch.testing.assert_close(a, b, rtol=2e-14, atol=1e-16)
    assert grey.averages(theta_i).A_b.shape == (60, 3)
    variance = torch.full((60, 3), 0.01, dtype=F64)
    torch.testing.assert_close(
        grey.single_scattered(theta_i, theta_r, phi, variance), full.single_scattered(theta_i, theta_r, phi, variance)
    )


def test_grey_is_refused_where_channels_differ() -> None:
    with pytest.raises(dsfit.InputError, match="terms.grey"):
        dsfit.DualScattering(dsfit.Fiber.preset("blond"), terms=Terms(grey=True))
    sigma_a = torch.full((3,), 0.1, dtype=F64, requires_grad=True)
    with pytest.raises(dsfit.InputError, match="terms.grey"):
        dsfit.DualScattering(dsfit.Fiber.preset("blond", sigma_a=sigma_a), terms=Terms(grey=True))


def test_gradients_of_what_is_kept() -> None:
    """Derivatives in the fibre and the angles of some terms are those of the sum less the others."""
    theta_i, theta_r, phi = (x[:8].requires_grad_() for x in directions())

    def slopes(terms: Terms) -> list[Tensor]:
        eta = torch.tensor(1.5, dtype=F64, requires_grad=True)
        sigma_a = torch.tensor([0.1, 0.3], dtype=F64, requires_grad=True)
        bsdf = dsfit.DualScattering(dsfit.Fiber(eta=eta, sigma_a=sigma_a), terms=terms)
        total = bsdf(theta_i, theta_r, phi, 2.0, 0.3).sum()
        return list(torch.autograd.grad(total, (eta, sigma_a, theta_i, phi), allow_unused=True))

    kept, rest, whole = slopes(Terms(("R", "TT"), ("back",))), slopes(Terms(("TRT", "back"), ("R", "TT", "TRT"))), None
    whole = slopes(Terms())
    for a, b, c in zip(kept, rest, whole, strict=True):
        torch.testing.assert_close(a + b, c, rtol=1e-9, atol=1e-12)


def test_nothing_left() -> None:
    bsdf = dsfit.DualScattering(dsfit.Fiber.preset("blond"), terms=Terms((), ()))
    theta_i, theta_r, phi = directions()
    assert bool((bsdf(theta_i, theta_r, phi, 2.0, 0.3) == 0).all())
    assert bool((bsdf.single(theta_i, theta_r, phi) == 0).all())


def test_names_keep_their_order() -> None:
    terms = Terms(direct=("back", "R"), scattered=["TRT", "TT"])  # type: ignore[arg-type]
    assert terms.direct == ("R", "back") and terms.scattered == ("TT", "TRT")
    assert terms.direct_lobes == (0,) and terms.scattered_lobes == (1, 2)
    assert hash(terms) == hash(Terms(("R", "back"), ("TT", "TRT")))


@pytest.mark.parametrize(
    "wrong",
    [
        {"direct": ("R", "glint")},
        {"scattered": ("R", "R")},
        {"direct": "R"},
        {"direct": None},
        {"scattered": (1,)},
        {"glint": 1},
        {"grey": "yes"},
    ],
)
def test_terms_that_are_none(wrong: dict[str, object]) -> None:
    with pytest.raises(dsfit.InputError, match=f"terms.{next(iter(wrong))}"):
        Terms(**wrong)  # type: ignore[arg-type]


def test_terms_of_another_type() -> None:
    with pytest.raises(dsfit.InputError, match="terms"):
        dsfit.DualScattering(dsfit.Fiber.preset("blond"), terms=("R",))  # type: ignore[arg-type]
