"""The peer with offsets over the fibre: unbiased, normalised across the caustic, N^G's measure of offsets right."""

from __future__ import annotations

import math

import pytest
import torch

import dsfit
from dsfit.proposals.deon import DeonProposal
from dsfit.proposals.deon_azimuth import OffsetFamily, TurnedOffset
from dsfit.proposals.offset_azimuth import OffsetAzimuth
from dsfit.race.peers.offset import DeonOffset
from tests.race.peers_support import CONTEXTS, estimates, integrand, is_centred, ready, root_mean_square


@pytest.mark.parametrize("uniforms", ["random", "sobol"])
def test_unbiased_and_a_bias_of_a_few_percent_is_seen(uniforms: str) -> None:
    found = estimates(ready(DeonOffset(), uniforms))
    assert is_centred(found)
    assert not is_centred(1.06 * found)


def test_a_density_that_forgets_how_the_lobe_was_chosen_is_seen(monkeypatch: pytest.MonkeyPatch) -> None:
    peer = DeonOffset()
    sampler = ready(peer)
    right = OffsetFamily._density

    def forgetful(self: OffsetFamily, theta_i: torch.Tensor, phi: torch.Tensor) -> torch.Tensor:
        third = [torch.full_like(theta_i, 1 / 3)] * 3
        with monkeypatch.context() as patch:
            patch.setattr(self, "weights", lambda sin_gamma, cos_gamma: third, raising=False)
            return right(self, theta_i, phi)

    monkeypatch.setattr(OffsetFamily, "_density", forgetful)
    assert not is_centred(estimates(sampler))


def test_sobol_points_lower_the_error() -> None:
    plain, quasi = (root_mean_square(estimates(ready(DeonOffset(), kind))) for kind in ("random", "sobol"))
    assert bool((quasi < 0.7 * plain).all())


@pytest.mark.parametrize("k", [0, 1])
def test_normalised_and_drawn_as_claimed(k: int) -> None:
    """Mass by quadrature that follows the caustic; and mean of 1 / (4 pi p), which is 1 only if p is what is drawn."""
    context, proposal = CONTEXTS[k].to(torch.float64), DeonProposal(integrand().bsdf)
    found = dsfit.excess(integrand(), proposal, context, 1e-2)
    assert abs(float(found.mass) - 1) < 2e-3
    u = torch.rand(40_000, 4, generator=torch.Generator().manual_seed(5), dtype=torch.float64)
    with torch.no_grad():
        _, log_p = proposal(context).sample_with_log_prob(u)
    ratio = torch.exp(-log_p) / (4 * math.pi)
    assert float(ratio.max()) <= 20 * (1 + 1e-9)  # the defensive share bounds weights
    assert abs(float(ratio.mean()) - 1) < 4 * float(ratio.std()) / 200


@pytest.mark.parametrize("lobe", ["R", "TT", "TRT"])
@pytest.mark.parametrize("theta_i", [0.0, -1.3, 1.2])
def test_turned_offsets_are_the_plain_ones_averaged_over_half_a_circle(lobe: str, theta_i: float) -> None:
    """Against a fine uniform grid of offsets: the share that leaves within pi/2 of phi."""
    context, theta = dsfit.Context(0.4), torch.tensor(theta_i, dtype=torch.float64)
    h = (torch.arange(200_000, dtype=torch.float64) + 0.5) / 200_000
    exit_at = OffsetAzimuth(lobe, 1.55)(context).sample(h[:, None], theta)
    law = TurnedOffset(lobe, 1.55)(context)
    for phi in torch.linspace(0.05, 3.1, 12, dtype=torch.float64):
        away = (torch.remainder(exit_at - phi + math.pi, 2 * math.pi) - math.pi).abs()
        share = float((away < math.pi / 2).double().mean()) / math.pi
        assert abs(float(torch.exp(law.log_prob(phi, theta))) - share) < 2e-5


def test_weights_of_the_family_sum_to_one_and_follow_absorption() -> None:
    h = torch.linspace(0, 0.999, 50, dtype=torch.float64)
    for preset, reflected in (("nonabsorbing", 0.06), ("black", 0.8)):
        proposal = DeonProposal(dsfit.DualScattering(dsfit.Fiber.preset(preset)))
        family = proposal(dsfit.Context(0.0)).components[0]
        weights = family.weights(h, torch.sqrt(1 - h * h))
        torch.testing.assert_close(weights[0] + weights[1] + weights[2], torch.ones_like(h))
        assert (float(weights[0][0]) > 0.5) == (reflected > 0.5)


def test_bad_options_are_named() -> None:
    with pytest.raises(dsfit.InputError, match="deon_offset.glint_share"):
        DeonOffset(glint_share=0.0)
    with pytest.raises(dsfit.InputError, match="deon_offset.defensive"):
        DeonOffset(defensive=1.0)
    with pytest.raises(dsfit.InputError, match="lobe"):
        TurnedOffset("TRRT", 1.55)
