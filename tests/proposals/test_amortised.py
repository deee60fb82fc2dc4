"""The amortised proposal: which lobes a context needs, limits of its domain, and its life as a proposal of a scene."""

from __future__ import annotations

import copy
import math
from pathlib import Path

import pytest
import torch

import dsfit
from dsfit.fit.amortise import held_out
from dsfit.proposals import AmortisedProposal, lobe_moments
from tests.proposals.cases_amortised import _random as changed
from tests.proposals.cases_amortised import bsdf, untrained

DIRECT, SCATTERED = slice(0, 3), slice(3, 8)
EDGE = math.radians(89.999)


def shares(proposal: AmortisedProposal, **context: float) -> torch.Tensor:
    return torch.exp(proposal.shape(dsfit.Context(0.4, **context)).log_weights)


def test_shares_of_exactly_0_leave_lobes_out() -> None:
    proposal = changed(0.3)
    direct = shares(proposal, n=0.0, v=1.0)
    assert not bool(direct[SCATTERED].any()) and bool((direct[DIRECT] > 0).all())
    scattered = shares(proposal, n=3.0, v=0.0)
    assert not bool(scattered[DIRECT].any()) and bool((scattered[SCATTERED] > 0).all())
    for n in (0.0, 3.0):
        assert bool((shares(proposal, n=n, v=0.5) > 0).all())
    for found in (direct, scattered):
        assert found.sum().item() == pytest.approx(1 - proposal.defensive, rel=1e-12)
    context = dsfit.Context(0.4, n=3.0, v=0.0)
    parameters = list(proposal.parameters())
    gradients = torch.autograd.grad(proposal(context).log_prob(torch.tensor([0.1, 0.2])).sum(), parameters)
    assert all(bool(g.isfinite().all()) for g in gradients)


def test_without_back_scattering_there_is_no_such_lobe() -> None:
    plain = AmortisedProposal(bsdf().replace(d_b=0.0), (4,))
    assert "back" in untrained().names and "back" not in plain.names
    assert len(plain.laws) == len(plain.names) == len(untrained().names) - 1
    context = dsfit.Context(0.4, n=2.0, v=0.3)
    assert held_out(dsfit.Integrand(bsdf().replace(d_b=0.0)), plain, context, check=0).worst < 0.05


def test_untrained_it_is_near() -> None:
    """The closed-form start alone, at contexts of every kind."""
    context = dsfit.Context(
        torch.tensor([0.3, -1.1, 1.4], dtype=torch.float64),
        n=torch.tensor([0.0, 4.0, 20.0], dtype=torch.float64),
        v=torch.tensor([1.0, 0.4, 0.0], dtype=torch.float64),
    )
    for preset, limit in (("blond", 0.03), ("black", 0.1)):
        assert held_out(dsfit.Integrand(bsdf(preset)), untrained(preset), context, check=0).worst < limit


@pytest.mark.parametrize("theta_r_deg", [-30.0, -6.0, -4.0, 0.0, 53.0])
def test_tables_see_peaks_next_to_grazing(theta_r_deg: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """Energies, modes and widths of black hair's lobes, whose a_f^n has narrow peaks there, against 20000 midpoints; to
    n = 64, beyond which nobody is trained."""
    theta_r = torch.tensor(math.radians(theta_r_deg), dtype=torch.float64)
    found = lobe_moments._row(bsdf("black"), theta_r, True)
    step = math.pi / 20000
    nodes = (torch.arange(20000, dtype=torch.float64) + 0.5) * step - math.pi / 2
    monkeypatch.setattr(lobe_moments, "panel_points", lambda *_: (nodes, torch.full_like(nodes, step)))
    exact = lobe_moments._row(bsdf("black"), theta_r, True)
    torch.testing.assert_close(found[0], exact[0], rtol=0, atol=1e-3)
    torch.testing.assert_close(found[1][:16], exact[1][:16], rtol=0, atol=2e-3)


@pytest.mark.parametrize(
    ("sigma_a", "beta"),
    [([0.0] * 3, None), ([1e4] * 3, None), ([0.1, 1.0, 10.0], 0.01), ([0.1, 1.0, 10.0], 60.0)],
    ids=["clear", "opaque", "narrow", "wide"],
)
def test_extreme_fibres_and_contexts_are_finite(sigma_a: list[float], beta: float | None) -> None:
    """n to 1e4 and beyond the tables, views to +-89.999 degrees, absorption 0 and 1e4, widths of 0.01 and 60 degrees:
    values and gradients."""
    widths = {} if beta is None else {"beta": torch.full((3,), math.radians(beta), dtype=torch.float64)}
    fiber = dsfit.Fiber.preset("blond", sigma_a=torch.tensor(sigma_a, dtype=torch.float64), **widths)
    proposal = AmortisedProposal(dsfit.DualScattering(fiber, precision="table"), (4,))
    with torch.no_grad():
        proposal.network.biases[-1].normal_(0, 0.5, generator=torch.Generator().manual_seed(2))
    for dtype in (torch.float64, torch.float32):
        theta = torch.tensor([EDGE, -EDGE, math.pi / 2, 0.0, 0.9], dtype=dtype)[:, None]
        n, v = torch.tensor([[0.0, 0.0, 1e-6, 30.0, 1e4, 1e5], [1.0, 0.0, 0.5, 1e-13, 0.0, 1.0]], dtype=dtype)
        _assert_finite(proposal, dsfit.Context(theta, 0.3, n, v))


def _assert_finite(proposal: AmortisedProposal, context: dsfit.Context) -> None:
    dtype, shape = context.dtype, context.batch_shape
    u = torch.rand(64, *shape, 3, generator=torch.Generator().manual_seed(3), dtype=dtype).clamp(1e-6, 1 - 1e-6)
    omega, log_prob = proposal(context).sample_with_log_prob(u)
    grid = torch.cartesian_prod(torch.linspace(-1.57, 1.57, 7), torch.linspace(-3.1, 3.1, 5)).to(dtype)
    elsewhere = proposal(context).log_prob(grid[:, None, None].expand(-1, *shape, -1))
    assert bool(omega.isfinite().all()) and bool(log_prob.isfinite().all()) and bool(elsewhere.isfinite().all())
    for value in (omega, log_prob, elsewhere):
        gradients = torch.autograd.grad(value.sum(), list(proposal.parameters()), retain_graph=True, allow_unused=True)
        assert all(g is None or bool(g.isfinite().all()) for g in gradients)


def test_beyond_the_tables_and_the_training_it_follows_n() -> None:
    """n = 100 and 500 for light hair, where float64 still knows a_f^n: the excess stays moderate."""
    context = dsfit.Context(0.5, n=torch.tensor([100.0, 500.0], dtype=torch.float64), v=0.0)
    clear = dsfit.DualScattering(dsfit.Fiber.preset("nonabsorbing"), precision="table")
    found = dsfit.excess(dsfit.Integrand(clear), AmortisedProposal(clear, (4,)), context, 1e-2)
    assert float(found.value.max()) < 0.1


def test_estimates_are_unbiased() -> None:
    context = dsfit.Context(
        torch.tensor([0.2, -1.0, 1.3], dtype=torch.float64),
        n=torch.tensor([0.0, 3.0, 8.0], dtype=torch.float64),
        v=torch.tensor([1.0, 0.2, 0.0], dtype=torch.float64),
    )
    integrand = dsfit.Integrand(bsdf())
    truth = dsfit.reference(integrand, context, 1e-5)
    found = dsfit.estimate(
        integrand, [changed(0.2).requires_grad_(False)], context, 20_000, generator=torch.Generator().manual_seed(8)
    )
    z = (found.value - truth.value) / found.standard_error
    assert float(z.abs().max()) < 4
    assert float((found.standard_error / found.value).max()) < 0.02


def test_saved_and_loaded_it_is_the_same(tmp_path: Path) -> None:
    proposal, path = changed(0.3).requires_grad_(False), tmp_path / "blond.npz"
    dsfit.save_proposal(path, proposal)
    again = dsfit.load_proposal(path)
    context = dsfit.Context(torch.tensor([0.3, -1.2], dtype=torch.float32), n=[0.0, 9.0], v=[0.7, 0.0])
    u = torch.rand(50, 2, 3, generator=torch.Generator().manual_seed(1))
    for one, other in zip(
        proposal(context).sample_with_log_prob(u), again(context).sample_with_log_prob(u), strict=True
    ):
        torch.testing.assert_close(one, other, rtol=0, atol=0)
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 0xFF
    path.write_bytes(content)
    with pytest.raises(dsfit.InputError, match="blond.npz"):
        dsfit.load_proposal(path)
    path.write_bytes(content[: len(content) // 2])
    with pytest.raises(dsfit.InputError, match="blond.npz"):
        dsfit.load_proposal(path)


@pytest.mark.parametrize(
    ("options", "field"),
    [({"defensive": 0.0}, "defensive"), ({"defensive": 1.0}, "defensive"), ({"hidden": (8, 0)}, "hidden")],
)
def test_bad_options_are_refused(options: dict[str, object], field: str) -> None:
    with pytest.raises(dsfit.InputError) as error:
        AmortisedProposal(bsdf(), **options)  # type: ignore[arg-type]
    assert error.value.field == field


def test_a_batch_of_fibres_is_refused() -> None:
    fiber = dsfit.Fiber.preset("blond", eta=torch.tensor([1.5, 1.6], dtype=torch.float64))
    with pytest.raises(dsfit.InputError, match="single"):
        AmortisedProposal(dsfit.DualScattering(fiber))


def test_copies_and_other_dtypes_work() -> None:
    """A copy in float32 gives the densities of the original."""
    proposal = changed(0.3)
    single = copy.deepcopy(proposal).float()
    context = dsfit.Context(0.3, n=2.0, v=0.4)
    omega = torch.tensor([[0.1, 0.2], [-0.4, 2.0]], dtype=torch.float64)
    found = single(context.to(torch.float32)).log_prob(omega.float())
    torch.testing.assert_close(found.double(), proposal(context).log_prob(omega), rtol=1e-4, atol=1e-4)
