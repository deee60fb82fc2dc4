"""The bounds of a plan hold: every term, random fibres, contexts and lights; and a wrong bound would be noticed."""

from __future__ import annotations

import dataclasses
import math

import pytest
import torch
from torch import Tensor

import dsfit
from dsfit.bsdf.terms import Terms
from dsfit.scene import ConstantScattering, SphereScattering, VonMisesFisherLights
from dsfit.scene.planning import optics as optics_module
from dsfit.scene.planning import terms as terms_module
from dsfit.scene.planning.boxes import Boxes, ContextRange
from dsfit.scene.planning.interval import Interval, RangeTable
from dsfit.scene.planning.surroundings import arrival, radiance
from dsfit.scene.planning.terms import NAMES, SUBSETS, TermBounds, bound_terms

DEG = math.pi / 180


def random_bsdf(g: torch.Generator, **options: object) -> dsfit.DualScattering:
    """A fibre with random optics and lobes, from clear to black; switches and model at random."""

    def uniform(low: float, high: float, *shape: int) -> Tensor:
        return low + (high - low) * torch.rand(shape, generator=g, dtype=torch.float64)

    def pick(*values: object) -> object:
        return values[int(torch.randint(len(values), (), generator=g))]

    fiber = dsfit.Fiber(
        sigma_a=10 ** uniform(-2.0, 1.0, 2) * pick(0.0, 1.0, 1.0),
        eta=uniform(1.2, 2.6),
        alpha=uniform(-20.0, 20.0, 3) * DEG,
        beta=10 ** uniform(-0.5, 1.3, 3) * DEG,
        caustic_width=uniform(4.0, 25.0) * DEG,
        glint_scale=uniform(0.0, 3.0),
        caustic_fade=uniform(0.1, 0.5),
        caustic_max_offset=uniform(0.0, 1.0),
    )
    convention = dsfit.Convention.named(
        back_azimuth=pick("all", "back"), absorption=pick("geometric", "printed2003"), split=pick("fraction", "half"),
        shift_sign=pick("minus", "plus"), lobe_norm=pick("energy", "energy", "printed"), density_power=pick(1, 2),
        mean_width=pick("variance", "width"), average_weight=pick("incident", "outgoing"),
        back_factor=pick("derived", "pi"),
    )  # fmt: skip
    model = str(pick("marschner", "marschner", "raw", "simplified"))
    d_f, d_b = float(uniform(0.2, 1.0)), float(uniform(0.05, 1.0))
    return dsfit.DualScattering(fiber, d_f, d_b, model, convention, **options)  # type: ignore[arg-type]


def random_context(g: torch.Generator) -> dsfit.Context:
    theta, n, v = torch.rand(3, generator=g, dtype=torch.float64)
    return dsfit.Context((2 * theta - 1) * 1.55, n=float(n) ** 3 * 30, v=float(v))


def bounds_of(bsdf: dsfit.DualScattering, context: dsfit.Context) -> TermBounds:
    return bound_terms(bsdf, Boxes.around(context), arrival(ConstantScattering()))


def violations(bounds: TermBounds, truth: Tensor) -> list[str]:
    """Terms whose integral is not between the bounds; 0.2 % is what quadrature may be off."""
    bad = []
    singles = torch.nonzero(SUBSETS.sum(1) == 1).flatten()
    lower = {int(SUBSETS[s].argmax()): bounds.kept[s, 0] for s in singles}
    for k, (half, name) in enumerate(NAMES):
        value = truth[k]
        if bool((value > bounds.upper[0, k] * 1.002 + 1e-290).any()):
            bad.append(f"{half} {name} above")
        if bool((lower[k] > value * 1.002 + 1e-290).any()):
            bad.append(f"{half} {name} below")
    return bad


@pytest.mark.parametrize("seed", range(4))
def test_every_term_is_between_its_bounds(seed: int) -> None:
    """Eight terms, two channels, below and above: 128 bounds; `test_many` has 3200."""
    g = torch.Generator().manual_seed(seed)
    bsdf, context = random_bsdf(g), random_context(g)
    assert violations(bounds_of(bsdf, context), direct_and_means(bsdf, context)) == []


@pytest.mark.parametrize("seed", range(2))
def test_every_term_is_between_its_bounds_for_a_poisson_number_of_fibres(seed: int) -> None:
    g = torch.Generator().manual_seed(40 + seed)
    bsdf, context = random_bsdf(g), random_context(g)
    bsdf = bsdf.replace(convention=dsfit.Convention.named(bsdf.convention, transmittance="poisson"))
    assert violations(bounds_of(bsdf, context), direct_and_means(bsdf, context)) == []


@pytest.mark.parametrize("n", [0.4, 20.0])
def test_bounds_for_a_poisson_number_of_fibres_are_tight(n: float) -> None:
    """Narrow lobes at grazing, where widths matter: every term within a factor of 2.5, and no violation."""
    fiber = dsfit.Fiber(sigma_a=(0.3, 3.0), beta=torch.tensor([2.0, 1.0, 3.0], dtype=torch.float64) * DEG)
    poisson = dsfit.Convention.named("consistent", transmittance="poisson")
    bsdf = dsfit.DualScattering(fiber, azimuthal="simplified", convention=poisson)
    context = dsfit.Context(torch.tensor(1.2, dtype=torch.float64), n=n, v=0.2)
    bounds, truth = bounds_of(bsdf, context), direct_and_means(bsdf, context)
    assert violations(bounds, truth) == []
    assert bool((bounds.upper[0, :8] < 2.5 * truth).all())
    single = SUBSETS[:, 4:].sum(1).eq(1) & SUBSETS[:, :4].sum(1).eq(0)
    order = SUBSETS[single].argmax(1)
    assert bool((bounds.kept[single, 0] > 0.4 * truth[order]).all())


def direct_and_means(bsdf: dsfit.DualScattering, context: dsfit.Context) -> Tensor:
    """Integral of every term by one-dimensional quadrature over theta_i: azimuths integrated as energies.

    int N dphi = int N^G dphi = E_p for the raw and simplified azimuths; for the treated TRT by two half circles of N^G.
    Midpoints on 20,000 inclinations, on panels that follow the lobes.
    """
    from dsfit.bsdf.attenuation import lobe_energies
    from dsfit.bsdf.azimuthal import refractions
    from dsfit.special import log_gauss

    fiber, convention = bsdf.fiber, bsdf.convention
    count = 20_000
    x = (torch.arange(count, dtype=torch.float64) + 0.5) / count
    wide = [torch.linspace(-math.pi / 2, math.pi / 2, 3, dtype=torch.float64)]
    for a, b in zip(fiber.alpha, fiber.beta, strict=True):
        wide.append(2 * a - context.theta_r + 2 * b * torch.linspace(-9, 9, 37, dtype=torch.float64))
    ends = torch.unique(torch.cat(wide).clamp(-math.pi / 2, math.pi / 2))
    share = (x * (len(ends) - 1)).to(torch.int64)
    place = x * (len(ends) - 1) - share
    width = ends[1:] - ends[:-1]
    theta_i = ends[share] + place * width[share]
    weight = width[share] * (len(ends) - 1) / count
    diff, half = (context.theta_r - theta_i) / 2, (context.theta_r + theta_i) / 2
    projection = (torch.cos(theta_i) / torch.cos(diff)) ** 2 * convention.lobe_constant * weight
    grid = torch.linspace(0.0, math.pi / 2, 400, dtype=torch.float64)
    energies = lobe_energies(refractions(fiber, grid, None), fiber.sigma_a, convention.absorption)
    if bsdf.model == "marschner":
        energies[:, 2] = _treated_energy(bsdf, grid)
    position = diff.abs() / (math.pi / 2) * 399
    row = position.to(torch.int64).clamp(0, 398)
    part = (position - row)[:, None, None]
    energies = energies[row] * (1 - part) + energies[row + 1] * part
    average = bsdf.averages(theta_i)
    n, v = context.n, context.v
    if convention.transmittance == "poisson":
        passed, spread = poisson_sums(average.a_f, n)
    else:
        passed, spread = torch.exp(n * torch.log(average.a_f.clamp_min(1e-300))), n
    passed, spread = bsdf.d_f**convention.density_power * passed, spread * average.beta_f**2
    back = 2 * math.pi if convention.back_azimuth == "all" else math.pi
    back = 2 * back / math.pi * bsdf.d_b * average.A_b
    pi = math.pi if convention.back_factor == "pi" else 1.0
    rows: list[Tensor] = []
    for k in range(3):
        lobe = torch.exp(log_gauss(half - fiber.alpha[k], fiber.beta[k]))[:, None]
        rows.append(v * lobe * energies[:, k])
    shifted = half[:, None] - average.delta_b
    rows.append(v * back * torch.exp(log_gauss(shifted, average.sigma_b)))
    for k in range(3):
        lobe = torch.exp(log_gauss(half[:, None] - fiber.alpha[k], torch.sqrt(fiber.beta[k] ** 2 + spread)))
        rows.append((1 - v) * passed * lobe * energies[:, k])
    rows.append((1 - v) * passed * pi * back * torch.exp(log_gauss(shifted, torch.sqrt(average.sigma_b**2 + spread))))
    return torch.stack([(row * projection[:, None]).sum(0) for row in rows])


def poisson_sums(a_f: Tensor, n: Tensor) -> tuple[Tensor, Tensor]:
    """sum_k P_k a_f^k and sum_k k P_k a_f^k over that, with P_k the Poisson law of mean n given k >= 1."""
    k = torch.arange(1.0, 200.0, dtype=torch.float64)
    weight = torch.exp(k * torch.log(n) - torch.lgamma(k + 1) - n) / -torch.expm1(-n) * a_f.unsqueeze(-1) ** k
    total = weight.sum(-1)
    return total, (k * weight).sum(-1) / total.clamp_min(1e-300)


def _treated_energy(bsdf: dsfit.DualScattering, theta_diff: Tensor) -> Tensor:
    """int N_TRT dphi with its caustic treated = pi (N^G(0) + N^G(pi)): two half circles."""
    ends = [bsdf.azimuthal_scattered(theta_diff, torch.full_like(theta_diff, x))[:, 2] for x in (0.0, math.pi)]
    return math.pi * (ends[0] + ends[1])


@pytest.mark.slow
@pytest.mark.parametrize("block", range(5))
def test_many(block: int) -> None:
    """100 random fibres and contexts, eight terms, two channels: 3200 bounds."""
    g = torch.Generator().manual_seed(1000 + block)
    for _ in range(20):
        bsdf, context = random_bsdf(g), random_context(g)
        assert violations(bounds_of(bsdf, context), direct_and_means(bsdf, context)) == []


@pytest.fixture(scope="module")
def cases() -> list[tuple[dsfit.DualScattering, dsfit.Context, Tensor]]:
    """Two random fibres in random contexts, with the integrals of their terms."""
    g = torch.Generator().manual_seed(5)
    found = [(random_bsdf(g), random_context(g)) for _ in range(2)]
    return [(bsdf, context, direct_and_means(bsdf, context)) for bsdf, context in found]


@pytest.mark.parametrize("wrong", ["a tenth", "no cos theta_i", "no widening", "absorption twice"])
def test_a_wrong_bound_is_noticed(
    wrong: str, cases: list[tuple[dsfit.DualScattering, dsfit.Context, Tensor]], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The same comparison, with a slip planted into the bounds; without one, nothing is noticed."""
    assert not any(violations(bounds_of(bsdf, context), truth) for bsdf, context, truth in cases)
    original_cells, original_depth = terms_module._Cells.of, optics_module._depth

    def no_cosine(theta_r: Interval) -> object:
        cells = original_cells(theta_r)
        across = (cells.theta_i.abs().low.cos() ** 2)[:, None, :, None, None].clamp_min(1e-9)
        return dataclasses.replace(cells, weight=Interval(cells.weight.low / across, cells.weight.high * across))

    if wrong == "no cos theta_i":
        monkeypatch.setattr(terms_module._Cells, "of", staticmethod(no_cosine))
    elif wrong == "absorption twice":
        monkeypatch.setattr(optics_module, "_depth", lambda *a: original_depth(*a) * 2.0)
    elif wrong == "no widening":
        original = terms_module._Cells.gauss
        monkeypatch.setattr(
            terms_module._Cells, "gauss", lambda self, c, s: original(self, c, Interval(s.low * 0.7, s.high * 0.7))
        )
    caught = []
    for bsdf, context, truth in cases:
        bounds = bounds_of(bsdf, context)
        if wrong == "a tenth":
            bounds = TermBounds(bounds.upper / 10, bounds.peak, bounds.kept)
        caught += violations(bounds, truth)
    assert caught


@pytest.mark.parametrize("seed", range(2))
def test_peaks_hold_in_every_direction_tried(seed: int) -> None:
    """The pointwise bound is proven; 4000 directions must not beat it, and come within a factor of it."""
    g = torch.Generator().manual_seed(seed)
    bsdf, context = random_bsdf(g), random_context(g)
    peak = bounds_of(bsdf, context).peak[0]
    omega = dsfit.quadrature_nodes(dsfit.Integrand(bsdf), context, 1e-1).omega
    for k, (half, name) in enumerate(NAMES):
        only = dsfit.Integrand(bsdf.replace(terms=Terms(**{"direct": (), "scattered": (), half: (name,)})))
        assert bool((only(omega, context).amax(0) <= peak[k]).all()), (half, name)


def test_table_is_bounded_by_itself() -> None:
    """Bounds of N^G from a spline's coefficients hold for what the spline gives."""
    bsdf = dsfit.DualScattering(dsfit.Fiber.preset("brown"), precision="table")
    context = dsfit.Context(0.9, n=4.0, v=0.3)
    bounds = bounds_of(bsdf, context)
    for k in (4, 5, 6):
        only = dsfit.Integrand(bsdf.replace(terms=Terms((), (NAMES[k][1],))))
        value = dsfit.reference(only, context, 1e-4).value
        single = int(torch.nonzero((SUBSETS.sum(1) == 1) & (SUBSETS[:, k] == 1)))
        assert bool((value <= bounds.upper[0, k]).all()) and bool((bounds.kept[single, 0] <= value).all())
        assert bool((bounds.upper[0, k] < 1.2 * value).all())


def test_what_the_treatment_of_the_caustic_changes() -> None:
    """|treated - raw| of TRT, in the integral and its absolute value, stays below the bound."""
    for theta_r, eta in ((0.2, 1.55), (1.4, 1.8)):
        fiber = dsfit.Fiber.preset("blond", eta=eta)
        treated = dsfit.DualScattering(fiber).replace(terms=Terms(("TRT",), ()))
        context = dsfit.Context(theta_r)
        change = bounds_of(dsfit.DualScattering(fiber), context).upper[0, 8]
        a = dsfit.reference(dsfit.Integrand(treated), context, 1e-3).value
        b = dsfit.reference(dsfit.Integrand(treated.replace(terms=Terms(("TRT",), (), glint=False))), context, 1e-3)
        assert bool(((a - b.value).abs() <= change).all())


@pytest.mark.parametrize("seed", range(2))
def test_a_range_holds_what_is_in_it(seed: int) -> None:
    """Bounds of boxes of theta_r and n enclose those of any context inside."""
    g = torch.Generator().manual_seed(seed)
    bsdf = random_bsdf(g)
    inside = ContextRange((0.70, 0.73), (2.0, 2.3), (0.4, 0.4))
    wide = bound_terms(bsdf, inside.boxes(), arrival(ConstantScattering()))
    for _ in range(3):
        a, b = torch.rand(2, generator=g, dtype=torch.float64)
        context = dsfit.Context(0.70 + 0.03 * a, n=2.0 + 0.3 * b, v=0.4)
        truth = direct_and_means(bsdf, context)
        assert bool((truth <= wide.upper.amax(0)[:8] * 1.002).all())
        assert bool((wide.kept[-1].amin(0) <= truth.sum(0) * 1.002).all())


def test_light_and_scattering_that_vary() -> None:
    """Radiance bounds of lobes hold everywhere; n and v of a ball are in one of the pairs in every direction."""
    light = VonMisesFisherLights(
        torch.tensor([[0.3, 1.0], [-0.4, 2.0]], dtype=torch.float64), [8.0, 1.0], [[1.0, 2.0], [0.5, 0.0]], 0.1
    )
    found = radiance(light)
    g = torch.Generator().manual_seed(0)
    omega = (torch.rand(4000, 2, generator=g, dtype=torch.float64) - 0.5) * torch.tensor([math.pi, 2 * math.pi])
    value = light(omega)
    assert found is not None and bool((value >= found.low).all()) and bool((value <= found.high).all())
    ball = SphereScattering(1.0, 3.0, (0.2, 0.3, 0.0))
    context = dsfit.Context(0.3)
    n, v = arrival(ball)(Boxes.around(context))
    true_n, true_v = ball(omega, context)
    held = (true_n[:, None] >= n.low[0]) & (true_n[:, None] <= n.high[0])
    held &= (true_v[:, None] >= v.low[0] - 1e-12) & (true_v[:, None] <= v.high[0] + 1e-12)
    assert bool(held.any(1).all())


def test_a_ball_is_bounded_too() -> None:
    """Where n varies with direction, the integral lies between the bounds."""
    bsdf = dsfit.DualScattering(dsfit.Fiber.preset("blond"), precision="table")
    ball = SphereScattering(1.0, 0.6, (0.2, 0.3, 0.0))
    context = dsfit.Context(0.4)
    bounds = bound_terms(bsdf, Boxes.around(context), arrival(ball))
    value = dsfit.reference(dsfit.Integrand(bsdf, scattering=ball), context, 1e-2).value
    assert bool((bounds.kept[-1, 0] <= value).all()) and bool((value <= bounds.upper[0, :8].sum(0)).all())
    assert bool((bounds.kept[-1, 0] > 0.1 * value).all())


def test_ranges_of_a_table() -> None:
    """Joined enclosures are those of all cells that an interval touches."""
    g = torch.Generator().manual_seed(0)
    breaks = torch.linspace(0, 1, 38, dtype=torch.float64)
    low = torch.rand(37, 2, generator=g, dtype=torch.float64)
    table = RangeTable(breaks, Interval(low, low + 1))
    ends = torch.rand(50, 2, generator=g, dtype=torch.float64).sort(-1).values
    found = table.over(Interval(ends[:, 0], ends[:, 1]))
    for k, (a, b) in enumerate(ends.tolist()):
        touched = (breaks[1:] >= a) & (breaks[:-1] <= b)
        torch.testing.assert_close(found.low[k], low[touched].amin(0), rtol=0, atol=0)
        torch.testing.assert_close(found.high[k], low[touched].amax(0) + 1, rtol=0, atol=0)
