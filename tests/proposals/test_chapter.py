"""The chapter's proposals by name, their parameters, and values of their laws."""

from __future__ import annotations

import copy
import math
import pickle
from types import SimpleNamespace

import pytest
import torch

from dsfit.context import Context
from dsfit.errors import InputError
from dsfit.proposals import (
    BackHalf,
    CosineHalf,
    GaussianLobe,
    Lobe,
    Scattered,
    TransmittanceCosine,
    TransmittanceGaussian,
    TruncatedGaussian,
    UniformInclination,
    WrappedGaussian,
    chapter_proposals,
)
from tests.proposals.cases import ALPHA, BETA, BETA_F, DEG, FakeBsdf, fake_fiber

NAMES = "M_R M_TT M_TRT R TT TRT transmittance_cosine transmittance_gaussian front uniform".split()
AVERAGED = "MG_R MG_TT MG_TRT back".split()


def f64(x: object) -> torch.Tensor:
    return torch.tensor(x, dtype=torch.float64)


def test_names() -> None:
    assert list(chapter_proposals(fake_fiber())) == NAMES
    assert list(chapter_proposals(FakeBsdf())) == NAMES + AVERAGED
    assert list(chapter_proposals(fake_fiber(), FakeBsdf())) == NAMES + AVERAGED


def test_parameters_are_those_of_the_fiber() -> None:
    proposals = chapter_proposals(FakeBsdf())
    for name in ALPHA:
        for proposal in (proposals[f"M_{name}"], proposals[name], proposals[f"MG_{name}"]):
            values = proposal.constrained()
            assert values["longitudinal.mean"][0].item() == pytest.approx(ALPHA[name])
            assert values["longitudinal.std"][0].item() == pytest.approx(BETA[name])
    assert proposals["TT"].constrained()["azimuthal.std"][0].item() == pytest.approx(30 * DEG)
    assert not list(chapter_proposals(FakeBsdf(), learnable=False)["back"].parameters())


def test_averages_are_frozen_at_the_specular_guess() -> None:
    bsdf = FakeBsdf()
    proposals = chapter_proposals(bsdf)
    theta_r = f64([0.3, -0.8])
    context = Context(theta_r, n=[0.0, 4.0])
    law = proposals["back"].longitudinal(context)
    torch.testing.assert_close(law.mean, 0.3 * torch.cos(theta_r))
    sigma_b = 0.2 + 0.05 * torch.cos(theta_r)
    torch.testing.assert_close(law.std, torch.sqrt(sigma_b**2 + f64([0.0, 4.0]) * BETA_F**2))
    widened = proposals["MG_TT"].longitudinal(context)
    torch.testing.assert_close(widened.std, torch.sqrt(BETA["TT"] ** 2 + f64([0.0, 4.0]) * BETA_F**2))
    assert bsdf.calls == 1  # every proposal shares them
    proposals["MG_R"](Context(theta_r.clone()))
    assert bsdf.calls == 1
    proposals["MG_R"](Context(theta_r + 0.1))
    assert bsdf.calls == 2
    assert copy.deepcopy(proposals["back"]).longitudinal.delta_b.function.averages.source is bsdf


def test_scattered_lobe_without_scattering_is_the_lobe() -> None:
    context, theta = Context(0.4, n=0.0, dtype=torch.float64), torch.linspace(-1.5, 1.5, 9, dtype=torch.float64)
    proposals = chapter_proposals(FakeBsdf())
    got, expected = (proposals[name].longitudinal(context).log_prob(theta) for name in ("MG_TT", "M_TT"))
    torch.testing.assert_close(got, expected)


def test_round_trips_of_module_state() -> None:
    proposal = chapter_proposals(FakeBsdf())["TT"]
    other = pickle.loads(pickle.dumps(proposal))
    other.load_state_dict(proposal.state_dict())
    omega = f64([[0.1, 2.0]])
    assert torch.equal(other(Context(0.2)).log_prob(omega), proposal(Context(0.2)).log_prob(omega))


def test_scattered_cosine_values() -> None:
    """N^G of cos(phi/2), whose integral is 4."""
    law = Scattered(CosineHalf())(Context(0.0, dtype=torch.float64))
    phi = f64([0.0, 0.5, math.pi / 2, 2.0, 2.8, math.pi])
    expected = f64([2 * math.sqrt(2) / math.pi, 0.8723276622, 2 / math.pi, 0.5156494875, 0.3860230741, 0.37292322857])
    torch.testing.assert_close(4 * torch.exp(law.log_prob(phi, phi)), expected, rtol=1e-9, atol=0)


def test_scattered_turns_by_a_quarter_at_most() -> None:
    context = Context(0.0, dtype=torch.float64)
    start = f64([[0.4, 0.0], [0.4, 0.5], [0.4, 1.0]])
    phi = Scattered(CosineHalf())(context).sample(start, start[:, 0])
    expected = CosineHalf()(context).sample(start[:1, :1], start[:1, 0]) + math.pi / 2 * f64([-1.0, 0.0, 1.0])
    torch.testing.assert_close(phi, expected)


def test_back_azimuth_follows_the_convention_of_the_bsdf() -> None:
    bsdf = FakeBsdf()
    bsdf.convention = SimpleNamespace(back_azimuth="back")
    omega = f64([[0.1, 3.0]])
    for choice, expected in ((None, -math.inf), ("back", -math.inf)):
        assert chapter_proposals(bsdf, back_azimuth=choice)["back"](Context(0.2)).log_prob(omega).item() == expected
    assert chapter_proposals(bsdf, back_azimuth="all")["back"](Context(0.2)).log_prob(omega).isfinite()


@pytest.mark.parametrize("gamma", [0.02, 0.05, 0.3, 0.899, 0.901, 2.5])
@pytest.mark.parametrize("law", [WrappedGaussian, TruncatedGaussian])
def test_scattered_gaussian_is_the_convolution(law: type, gamma: float) -> None:
    """Closed form against the average of the base density over +-pi/2 by quadrature."""
    context = Context(0.0, dtype=torch.float64)
    base = law(gamma)(context)
    phi = torch.linspace(-3.1, 3.1, 23, dtype=torch.float64)
    steps = torch.linspace(0, 1, 200_001, dtype=torch.float64)[:-1] + 2.5e-6
    turned = phi[:, None] + math.pi * (steps - 0.5)
    turned = torch.atan2(torch.sin(turned), torch.cos(turned))
    expected = torch.exp(base.log_prob(turned, turned)).mean(dim=-1)
    got = torch.exp(Scattered(law(gamma))(context).log_prob(phi, phi))
    torch.testing.assert_close(got, expected, rtol=1e-5, atol=1e-7)


def test_scattered_gaussian_is_finite_in_logs_where_the_density_underflows() -> None:
    for dtype in (torch.float64, torch.float32):
        phi = torch.tensor([0.0, 0.3, 1.0], dtype=dtype)
        for gamma in (1e-3, 0.02, 0.046, 0.139, 0.15):
            law = Scattered(WrappedGaussian(gamma))(Context(0.0, dtype=dtype))
            value = law.log_prob(phi, phi)
            assert value.isfinite().all()
            exact = Scattered(WrappedGaussian(gamma))(Context(0.0, dtype=torch.float64)).log_prob(phi.double(), phi)
            torch.testing.assert_close(value.double(), exact, rtol=2e-5, atol=1e-5)


def test_transmittance_limits() -> None:
    """A wide Gaussian in theta_diff is uniform, 2 / pi on [L, H]; the cosine law has the closed form of E4."""
    theta = torch.linspace(-1.5, 1.5, 7, dtype=torch.float64)
    context = Context(0.6, dtype=torch.float64)
    flat = torch.exp(TransmittanceGaussian(99.0)(context).log_prob(theta))
    torch.testing.assert_close(flat, torch.full_like(theta, 1 / math.pi), rtol=1e-3, atol=0)
    cosine = torch.exp(TransmittanceCosine()(context).log_prob(theta))
    expected = torch.cos((0.6 - theta) / 2) / (2 * math.sqrt(2) * math.cos(0.3))
    torch.testing.assert_close(cosine, expected)


def test_supports() -> None:
    context = Context(0.3, dtype=torch.float64)
    beyond = f64([1.6, -1.7])
    for law in (GaussianLobe(0.1, 0.2), TransmittanceCosine(), UniformInclination()):
        assert bool((law(context).log_prob(beyond) == -math.inf).all())
    back = BackHalf()(context)
    assert back.log_prob(f64([3.0, 1.0]), beyond).tolist() == [-math.inf, -math.log(math.pi)]


def test_input_errors() -> None:
    with pytest.raises(InputError, match="name"):
        Lobe("TRRT", 0.0, 0.1)
    with pytest.raises(InputError, match="gamma_tt"):
        Lobe("TT", 0.0, 0.1)
    with pytest.raises(InputError, match="std"):
        GaussianLobe(0.0, 0.0)
    with pytest.raises(InputError, match="mean"):
        GaussianLobe(math.nan, 0.1)
    with pytest.raises(InputError, match="variable"):
        TransmittanceGaussian(0.3, variable="half")
    with pytest.raises(InputError, match="back_azimuth"):
        chapter_proposals(FakeBsdf(), back_azimuth="front")
    with pytest.raises(InputError, match="averages"):
        chapter_proposals(fake_fiber(), object())
    with pytest.raises(InputError, match="base"):
        Scattered(Scattered(CosineHalf()))(Context(0.0))
