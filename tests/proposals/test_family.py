"""The proposal of a fibre of a family: a proper distribution at every context, made from tables that agree with the
BSDF."""

from __future__ import annotations

import copy
import math
from pathlib import Path

import pytest
import torch
from torch import Tensor

import dsfit
from dsfit.context import Context
from dsfit.errors import InputError
from dsfit.frame import HALF_PI, cos_inclination, wrap
from dsfit.proposals.family import FamilyMember, FamilyProposal
from dsfit.proposals.fiber_family import FiberFamily
from dsfit.proposals.lobe_moments import LobeMoments
from dsfit.proposals.quick_moments import QuickMoments
from dsfit.proposals.quick_tables import QuickScattering
from dsfit.quadrature import merge_breaks, panel_points
from tests.proposals.grid import chi_square, counts

DEG = math.pi / 180
CELLS = (24, 24)
FIBERS = {
    "round": {"sigma_a": (0.3, 0.5, 0.9)},
    "eccentric": {"sigma_a": (0.05, 0.09, 0.2), "eccentricity": 0.9},
}


@pytest.fixture(scope="module")
def family() -> FamilyProposal:
    """A family whose network says something: its last layer is no longer zero."""
    proposal = FamilyProposal(hidden=(12,))
    generator = torch.Generator().manual_seed(5)
    with torch.no_grad():
        last = proposal.network.weights[-1]
        last.copy_(0.1 * torch.randn(last.shape, generator=generator, dtype=torch.float64))
    return proposal


@pytest.fixture(scope="module")
def members(family: FamilyProposal) -> dict[str, FamilyMember]:
    return {name: family.of(bsdf_of(name)) for name in FIBERS}


def bsdf_of(name: str, **options: float) -> dsfit.DualScattering:
    return dsfit.DualScattering(dsfit.Fiber(**FIBERS[name]), **options)


def contexts(dtype: torch.dtype = torch.float64) -> Context:
    theta_r = torch.tensor([0.0, 50.0, -80.0, 89.5, 20.0], dtype=dtype) * DEG
    n = torch.tensor([0.0, 2.0, 9.0, 30.0, 0.0], dtype=dtype)
    v = torch.tensor([1.0, 0.4, 0.0, 0.0, 0.0], dtype=dtype)
    return Context(theta_r, 0.7, n, v)


@pytest.mark.parametrize("name", FIBERS)
def test_normalised_and_sampled_as_claimed(members: dict[str, FamilyMember], name: str) -> None:
    """Panels end where the azimuth tables have their rows and columns; 5 contexts of 2 fibres, 1 % for all together."""
    level = -math.expm1(math.log1p(-0.01) / (len(FIBERS) * 5))
    for k, context in enumerate(contexts()[i] for i in range(5)):
        with torch.no_grad():
            distribution = members[name](context)
            masses = _masses(members[name], context)
            assert abs(float(masses.sum()) - 1) < 1e-6, k
            generator = torch.Generator().manual_seed(k)
            u = torch.rand(20_000, distribution.dimension, generator=generator, dtype=torch.float64)
            omega = distribution.sample(u)
            assert chi_square(counts(omega, context, CELLS), masses) > level, k


def _masses(member: FamilyMember, context: Context) -> Tensor:
    """Mass of the density in cells of (theta_i, phi); it is even in phi."""
    shape = member.shape(context)
    rows, columns = member.laws[0].density.shape
    kinks = torch.linspace(-math.pi, math.pi, 2 * rows - 1, dtype=torch.float64) + context.theta_r
    steps = torch.tensor([-8.0, -5.0, -3.0, -1.5, 0.0, 1.5, 3.0, 5.0, 8.0], dtype=torch.float64)
    width = torch.minimum(shape.below, shape.above)
    peaks = (2 * (shape.mode[:, None] + width[:, None] * steps) - context.theta_r).flatten()
    ends = torch.tensor([side * (HALF_PI - 0.2 * 2.0**-k) for side in (-1, 1) for k in range(12)], dtype=torch.float64)
    cells = torch.linspace(-HALF_PI, HALF_PI, CELLS[0] + 1, dtype=torch.float64)
    breaks = merge_breaks(torch.cat([kinks, peaks, ends, cells]), -HALF_PI, HALF_PI, 1e-9)
    theta, theta_weight = panel_points(breaks, 6)
    phi, phi_weight = panel_points(torch.linspace(0.0, math.pi, columns, dtype=torch.float64), 2)
    omega = torch.stack(torch.broadcast_tensors(theta[:, None], wrap(context.phi_r - phi)), dim=-1)
    mass = torch.exp(member(context).log_prob(omega)) * cos_inclination(theta)[:, None]
    mass = mass * theta_weight[:, None] * phi_weight
    half = CELLS[1] // 2
    row = ((theta + HALF_PI) / math.pi * CELLS[0]).long().clamp(0, CELLS[0] - 1)
    column = (phi / math.pi * half).long().clamp(0, half - 1)
    found = torch.zeros(CELLS[0], half, dtype=torch.float64)
    found.index_put_((row[:, None], column[None, :]), mass, accumulate=True)
    return torch.cat([found.flip(1), found], dim=1)


@pytest.mark.parametrize("name", FIBERS)
def test_estimates_are_unbiased(members: dict[str, FamilyMember], name: str) -> None:
    """Against the structured proposal, which shares nothing but the azimuth law's code."""
    context = contexts()[:3]
    integrand = dsfit.Integrand(QuickScattering(bsdf_of(name)))
    structured = dsfit.StructuredProposal(integrand.bsdf, context, defensive=0.05)
    found = []
    for k, proposal in enumerate((members[name], structured)):
        generator = torch.Generator().manual_seed(k)
        found.append(dsfit.estimate(integrand, proposal, context, 4096, generator=generator, test=False))
    error = torch.sqrt(found[0].standard_error ** 2 + found[1].standard_error ** 2)
    score = ((found[0].value - found[1].value) / error).abs()
    assert float(score.max()) < 4.0  # 9 scores: 6e-4
    assert float((found[0].standard_error / found[0].value).max()) < 0.05


def test_tables_agree_with_the_bsdf() -> None:
    generator = torch.Generator().manual_seed(0)
    bsdf = bsdf_of("round")
    quick = QuickScattering(bsdf)
    theta = torch.linspace(-1.56, 1.56, 101, dtype=torch.float64)
    exact, found = bsdf.averages(theta), quick.averages(theta)
    for field in ("a_f", "a_b", "beta_f", "A_b", "delta_b", "sigma_b"):
        torch.testing.assert_close(getattr(found, field), getattr(exact, field), rtol=2e-3, atol=3e-4)
    diff, phi = torch.rand(2, 200, generator=generator, dtype=torch.float64) * torch.tensor([[1.5], [math.pi]])
    exact_n, found_n = (f.azimuthal_scattered(diff, phi) for f in (bsdf, quick))
    assert float(((exact_n - found_n).abs() / exact_n.amax(0)).max()) < 0.02
    assert float(((exact_n - found_n).abs() / exact_n.amax(0)).mean()) < 5e-4


def test_tables_know_the_orientation_of_the_section() -> None:
    generator = torch.Generator().manual_seed(0)
    bsdf = bsdf_of("eccentric")
    diff, phi, phi_h = torch.rand(3, 100, generator=generator, dtype=torch.float64) * torch.tensor([[1.5], [3.14], [6]])
    exact, found = (f.azimuthal_scattered(diff, phi, phi_h=phi_h) for f in (bsdf, QuickScattering(bsdf)))
    assert float(((exact - found).abs() / exact.amax(0)).mean()) < 3e-3


def test_moments_agree_with_those_of_the_amortised_proposal(monkeypatch: pytest.MonkeyPatch) -> None:
    from dsfit.proposals import lobe_moments, quick_moments

    monkeypatch.setattr(lobe_moments, "_DEPTHS", quick_moments._DEPTHS)
    quick = QuickScattering(bsdf_of("round"))
    exact, found = LobeMoments(quick), QuickMoments(quick)
    for name in ("direct", "scattered"):
        a, b = getattr(exact, name)[5:-5], getattr(found, name)[5:-5]
        assert float((a - b)[..., :2, :].abs().max()) < 0.01  # log energies and means
        assert float((a - b)[..., 2:, :].abs().quantile(0.9)) < 0.05  # log widths


def test_untrained_it_is_near() -> None:
    """The tables alone, without a network's correction."""
    bsdf = QuickScattering(bsdf_of("round"))
    member = FamilyProposal().of(bsdf)
    context = Context(torch.tensor([-0.6], dtype=torch.float64), 0.0, 5.0)
    nodes = dsfit.quadrature_nodes(dsfit.Integrand(bsdf), context[0], 1e-3)
    with torch.no_grad():
        density = torch.exp(member(context[0]).log_prob(nodes.omega))
    norm = (nodes.weight * nodes.norm).sum()
    assert float((nodes.weight * nodes.norm**2 / density).sum() / norm**2) < 1.02
    assert abs(float((nodes.weight * density).sum()) - 1) < 1e-2


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_gradients_are_finite(members: dict[str, FamilyMember], dtype: torch.dtype) -> None:
    context = contexts(dtype)
    member = copy.deepcopy(members["round"])
    distribution = member(context)
    generator = torch.Generator().manual_seed(1)
    u = torch.rand(50, 5, distribution.dimension, generator=generator).to(dtype).clamp(1e-6, 1 - 1e-6)
    omega, log_prob = distribution.sample_with_log_prob(u)
    assert omega.dtype == dtype and bool(log_prob.isfinite().all())
    log_prob.sum().backward()
    gradients = [p.grad for p in member.network.parameters()]
    assert all(g is not None and bool(g.isfinite().all()) for g in gradients)
    assert any(bool((g != 0).any()) for g in gradients if g is not None)


def test_gradients_in_the_context_are_finite(members: dict[str, FamilyMember]) -> None:
    given = contexts()
    leaves = [x.clone().requires_grad_(True) for x in (given.theta_r, given.n, given.v)]
    context = Context(leaves[0], given.phi_r, leaves[1], leaves[2])
    omega = torch.tensor([0.2, 1.0], dtype=torch.float64).expand(5, 2)
    members["round"](context).log_prob(omega).sum().backward()
    assert all(x.grad is not None and bool(x.grad.isfinite().all()) for x in leaves)


def test_float32_follows_float64(members: dict[str, FamilyMember]) -> None:
    context = contexts()
    generator = torch.Generator().manual_seed(2)
    omega = (torch.rand(200, 5, 2, generator=generator, dtype=torch.float64) - 0.5) * torch.tensor([3.0, 6.0])
    with torch.no_grad():
        wide = members["round"](context).log_prob(omega)
        narrow = members["round"](context.to(torch.float32)).log_prob(omega.float())
    assert narrow.dtype == torch.float32
    torch.testing.assert_close(narrow.double(), wide, rtol=0, atol=2e-2)
    assert float((narrow - wide).abs().median()) < 1e-4


def test_saved_and_loaded(family: FamilyProposal, members: dict[str, FamilyMember], tmp_path: Path) -> None:
    context = contexts()
    for name, proposal in (("family", family), ("member", members["eccentric"])):
        dsfit.save_proposal(tmp_path / name, proposal)
        loaded = dsfit.load_proposal(tmp_path / name)
        member = loaded.of(bsdf_of("eccentric")) if name == "family" else loaded
        for a, b in zip(
            vars(member.shape(context)).values(), vars(members["eccentric"].shape(context)).values(), strict=True
        ):
            torch.testing.assert_close(a, b, rtol=0, atol=0)


def test_network_is_shared(family: FamilyProposal, members: dict[str, FamilyMember]) -> None:
    assert all(member.network is family.network for member in members.values())


def test_same_seed_same_fibres() -> None:
    first, second = (FiberFamily().draw(6, torch.Generator().manual_seed(3)) for _ in range(2))
    other = FiberFamily().draw(6, torch.Generator().manual_seed(4))
    for a, b, c in zip(first, second, other, strict=True):
        assert torch.equal(a.fiber.beta, b.fiber.beta) and not torch.equal(a.fiber.beta, c.fiber.beta)


def test_drawn_fibres_belong_to_the_family() -> None:
    family = FiberFamily()
    drawn = family.draw(256, torch.Generator().manual_seed(0))
    assert all(not family.outside(bsdf) for bsdf in drawn)
    share = sum(not bsdf.fiber.is_round for bsdf in drawn) / len(drawn)
    assert abs(share - family.eccentric) < 0.02
    darkest = max(float(bsdf.fiber.sigma_a.max()) for bsdf in drawn)
    assert darkest > 8 and any(float(bsdf.fiber.sigma_a.max()) == 0 for bsdf in drawn)


def test_presets_belong_to_the_family() -> None:
    for name in dsfit.Fiber.presets():
        assert not FiberFamily().outside(dsfit.DualScattering(dsfit.Fiber.preset(name)))


@pytest.mark.parametrize(
    ("field", "options", "densities"),
    [
        ("sigma_a", {"sigma_a": (1.0, 2.0, 20.0)}, {}),
        ("beta_R", {"beta": (2 * DEG, DEG, 4 * DEG)}, {}),
        ("beta_TT / (beta_R / 2)", {"beta": (8 * DEG, 8 * DEG, 16 * DEG)}, {}),
        ("alpha_R", {"alpha": (0.0, 0.0, 0.0)}, {}),
        ("alpha_TT / alpha_R", {"alpha": (-5 * DEG, 5 * DEG, 7.5 * DEG)}, {}),
        ("eccentricity", {"eccentricity": 1.1}, {}),
        ("eta", {"eta": 1.4}, {}),
        ("d_f", {}, {"d_f": 0.2}),
    ],
)
def test_fibres_outside_are_refused(family: FamilyProposal, field: str, options: dict, densities: dict) -> None:
    bsdf = dsfit.DualScattering(dsfit.Fiber(**options), **densities)
    with pytest.raises(InputError) as error:
        family.of(bsdf)
    assert field in str(error.value)


def test_extrapolated_fibres_are_still_proper(family: FamilyProposal) -> None:
    member = family.of(dsfit.DualScattering(dsfit.Fiber(sigma_a=(1.0, 2.0, 20.0), eta=1.4)), extrapolate=True)
    with torch.no_grad():
        assert abs(float(_masses(member, contexts()[1]).sum()) - 1) < 1e-6


@pytest.mark.parametrize(
    "call",
    [
        lambda: FamilyProposal(defensive=0.0),
        lambda: FamilyProposal(family=3),  # type: ignore[arg-type]
        lambda: FiberFamily(absorption=(0.5, 0.1)),
        lambda: FiberFamily(width=7.0),  # type: ignore[arg-type]
        lambda: FiberFamily(spread=0.5),
        lambda: FiberFamily(eccentricity=(0.5, 1.0)),
        lambda: FiberFamily().draw(0, torch.Generator()),
        lambda: FamilyProposal().of(dsfit.DualScattering(dsfit.Fiber(eta=torch.tensor([1.5, 1.6])))),
        lambda: FamilyProposal().of(dsfit.DualScattering(dsfit.Fiber(), d_b=0.0)),
        lambda: FamilyProposal().of("hair"),  # type: ignore[arg-type]
        lambda: FamilyProposal()(contexts()),
    ],
)
def test_bad_input_is_told(call) -> None:  # noqa: ANN001
    with pytest.raises(InputError):
        call()
