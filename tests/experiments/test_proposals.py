"""The figure of proposals: printed forms are what the errata say, corrected forms are densities that are drawn."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import kstwo, norm
from torch import Tensor

from dsfit.bsdf.dual_scattering import DualScattering
from dsfit.bsdf.fiber import Fiber
from dsfit.checks.finding import sidak
from dsfit.context import Context
from dsfit.figures import Data, Estimate, Exact
from dsfit.figures.catalogue import find
from dsfit.figures.data import read_data, write_data
from dsfit.figures.experiment import Work
from dsfit.figures.page import Page
from dsfit.figures.verify import error_name, rules_of
from dsfit.proposals.base import Distribution, Product, Proposal
from dsfit.proposals.gaussian_lobe import GaussianLobe
from dsfit.proposals.printed import CosineAsPrinted
from dsfit.proposals.structured import StructuredProposal
from dsfit.proposals.uniform import UniformAzimuth, UniformSphere
from experiments import _proposals_maps as maps
from experiments._proposals_laws import DEG, at, laws
from experiments._proposals_measure import AXES, LEVELS, counts, distance, draw, marginal, point_share, quantiles
from experiments._proposals_own import components, measure_own
from experiments.drawing import proposals as drawing
from experiments.proposals import EXPERIMENT, WRONG, Proposals, described, measure_laws, measure_maps

ROOT = Path(__file__).parents[2]
SAMPLES = 4000


class Slipped(Proposal):
    """Draws by one proposal and claims the density of another."""

    def __init__(self, drawn: Proposal, claimed: Proposal) -> None:
        super().__init__()
        self.drawn, self.claimed = drawn, claimed

    def forward(self, context: Context) -> Distribution:
        drawn, claimed = self.drawn(context), self.claimed(context)

        class Both(Distribution):
            dimension, batch_shape = drawn.dimension, context.batch_shape

            def sample_with_log_prob(self, u: Tensor) -> tuple[Tensor, Tensor]:
                omega = drawn.sample(u)
                return omega, claimed.log_prob(omega)

            def log_prob(self, omega: Tensor) -> Tensor:
                return claimed.log_prob(omega)

        return Both()


def lobe(width: float) -> Product:
    return Product(GaussianLobe(-7.5 * DEG, width), UniformAzimuth())


@pytest.fixture(scope="module")
def chapter():
    return laws(DualScattering(Fiber.preset("blond"), precision="table"), 45.0, 80.0, 3.0)


@pytest.fixture(scope="module")
def measured(chapter):
    return measure_laws(chapter, Proposals(samples=SAMPLES), lambda _: None)


def row(chapter, arrays, key: str, name: str):
    return arrays[key][[law.name for law in chapter].index(name)]


def test_corrected_forms_are_densities_and_their_samplers_draw_them(chapter, measured):
    assert np.abs(measured["mass"][:, 1] - 1).max() < 1e-6
    assert (measured["points"][:, 1] == 0).all()
    p = kstwo.sf(measured["distance"][:, 2], SAMPLES)
    assert p.min() > sidak(0.001, len(p))


def test_every_printed_form_is_seen_to_be_wrong(chapter, measured):
    p = kstwo.sf(measured["distance"][:, 1], SAMPLES)
    wrong = (np.abs(measured["mass"][:, 0] - 1) > 1e-3) | (measured["points"][:, 0] > 0.005) | (p < 1e-6)
    assert wrong.all(), [law.name for law, bad in zip(chapter, wrong, strict=True) if not bad]


@pytest.mark.parametrize(
    ("name", "mass"),
    [
        ("angular", 6.10),
        ("clamp_R", 0.369),
        ("unwrapped", 0.5),
        ("azimuth_mass", math.erf(math.pi / (2 * math.sqrt(2)))),
        ("front", 2.0),
        ("difference_mass", math.cos(22.5 * DEG) / math.sqrt(2)),
        ("cosine", 1.0),
    ],
)
def test_masses_of_printed_densities(chapter, measured, name, mass):
    assert row(chapter, measured, "mass", name)[0] == pytest.approx(mass, abs=6e-3)


def test_clamping_heaps_up_what_is_cut_off(chapter, measured):
    beyond = norm.cdf((40 - 45 + 7.5) / 7.5)
    assert row(chapter, measured, "points", "clamp_R")[0] == pytest.approx(beyond, abs=1e-3)
    assert np.degrees(measured["clamp_R.printed.quantiles"][: int(beyond * (LEVELS - 1))]).max() < -90 + 1e-3


def test_printed_distribution_functions_exceed_one_and_their_inverses_stop(measured):
    assert measured["cosine.printed.cdf"][-1] == pytest.approx(4, abs=1e-6)
    assert np.degrees(measured["cosine.printed.quantiles"].max()) == pytest.approx(-60, abs=0.1)
    assert measured["inclination.printed.cdf"][-1] == pytest.approx(2, abs=1e-6)
    assert np.degrees(measured["inclination.printed.quantiles"].max()) == pytest.approx(0, abs=0.1)


def test_inverse_and_distribution_function_undo_each_other(chapter, measured):
    u = np.linspace(0, 1, LEVELS)
    for law in chapter:
        cdf = measured[f"{law.name}.corrected.cdf"]
        x = np.linspace(*AXES[law.axis], len(cdf))
        back = np.interp(measured[f"{law.name}.corrected.quantiles"], x, cdf)
        assert np.abs(back - u).max() < 6e-3, law.name


def test_transmittance_follows_the_fitted_gaussian_not_the_cosine(measured):
    target = measured["fitted.target"]
    gap = {form: np.abs(measured[f"fitted.{form}.density"] - target).max() for form in ("printed", "corrected")}
    assert gap["corrected"] < 0.1 * gap["printed"]


def test_marginals_of_the_uniform_sphere():
    law = marginal(UniformSphere()(at(0.0)), at(0.0), "theta", 90)
    assert law.density == pytest.approx(np.cos(law.x) / 2, abs=1e-12)
    assert law.cdf == pytest.approx((1 + np.sin(law.x)) / 2, abs=1e-7)
    assert marginal(UniformSphere()(at(0.0)), at(0.0), "forward", 90).mass == pytest.approx(1, abs=1e-9)


@pytest.mark.parametrize("width", [7.5, 6.0])
def test_a_sampler_of_another_width_is_seen(width):
    context, right = at(45.0), lobe(7.5 * DEG)
    distribution = Slipped(lobe(width * DEG), right)(context)
    drawn = draw(distribution, context, "theta", 20_000, 3)
    p = kstwo.sf(distance(drawn, marginal(distribution, context, "theta")), 20_000)
    assert p > 1e-3 if width == 7.5 else p < 1e-6


def test_distance_counts_ties():
    law = marginal(UniformSphere()(at(0.0)), at(0.0), "theta", 90)
    assert distance(np.zeros(100), law) == pytest.approx(0.5, abs=1e-6)
    assert distance(np.full(100, -math.pi / 2), law) == pytest.approx(1.0, abs=1e-6)


def test_point_share_of_a_density_is_zero_and_counts_are_all_there():
    context = at(45.0)
    distribution = lobe(7.5 * DEG)(context)
    assert point_share(distribution, context, "theta") == 0
    assert counts(draw(distribution, context, "phi", 500, 1), "phi", 16).sum() == 500
    ordered = quantiles(distribution, context, "theta")
    assert len(ordered) == LEVELS and (np.diff(ordered) >= 0).all()


@pytest.mark.parametrize(
    ("proposal", "right"),
    [(lobe(7.5 * DEG), True), (Slipped(lobe(6.0 * DEG), lobe(7.5 * DEG)), False), (CosineAsPrinted(), False)],
)
def test_maps_tell_a_right_sampler_from_a_wrong_one(proposal, right):
    found = maps.measure(proposal, at(45.0), 20_000, 5)
    assert found.observed.sum() == 20_000 and found.mass == pytest.approx(1, abs=1e-5)
    assert (found.p_value > 1e-4) if right else (found.p_value < 1e-6)


def kept_in_files(data: Data, folder: Path) -> Data:
    write_data(folder, data)
    return read_data(folder)


@pytest.fixture(scope="module")
def stored(chapter, measured, tmp_path_factory) -> Data:
    """A page of laws, a mixture and two maps, through the files."""
    context, bsdf = at(45.0, 3.0), DualScattering(Fiber.preset("blond"), precision="table")
    own = {"structured": StructuredProposal(bsdf, context)}
    shown, found = measure_own(bsdf, own, context, 1000, 48, 1, lambda _: None)
    over_both = {"M_R": lobe(7.5 * DEG), WRONG: CosineAsPrinted()}
    arrays = measured | shown | measure_maps(over_both, context, 5000, 1, lambda _: None)
    arrays |= {"own.distance": found, "own.distance_error": found}
    arrays |= {key: measured[key][6:9] for key in ("mass", "points", "distance")}
    record = {
        "preset": "blond",
        "context": [45.0, 3.0, 0.5],
        "samples": SAMPLES,
        "map_samples": 5000,
        "laws": [described(law) for law in chapter[6:9]],
        "own": [{"name": name, "parts": components(proposal)} for name, proposal in own.items()],
        "maps": list(over_both),
    }
    return kept_in_files(Data(arrays, record), tmp_path_factory.mktemp("proposals"))


def test_everything_is_drawn_from_the_files_alone(stored):
    figures = drawing.figures(stored, Page())
    assert list(figures) == ["clamp", "own", "maps"]
    for figure in figures.values():
        assert figure.get_size_inches()[0] * 25.4 == pytest.approx(150)
    figures["clamp"].draw_without_rendering()
    names = {table.name: table for table in drawing.tables(stored)}
    assert [cells[5] for cells in names["forms"].rows][0] == "63.1%"
    assert [cells[-1] == "< 1e-6" for cells in names["maps"].rows] == [False, True]


@pytest.mark.slow
def test_the_small_run_is_drawn_in_full(tmp_path):
    entry = find(ROOT, "proposals")
    computed = entry.experiment.compute(entry.settings(entry.experiment.small), Work(tmp_path, ROOT, lambda _: None))
    data = kept_in_files(computed, tmp_path)
    pages = ["longitudinal", "clamp", "transmitted", "cosine", "transmittance", "scattered", "own", "maps"]
    assert list(drawing.figures(data, Page())) == pages
    names = {table.name: table for table in drawing.tables(data)}
    assert len(names["forms"].rows) == len(data.record["laws"])
    assert [cells[0] for cells in names["own"].rows] == ["structured", "fitted", "amortised"]
    assert names["maps"].rows[-1][-1] == "< 1e-6"
    assert (tmp_path / "data.npz").stat().st_size < 300_000


def test_components_add_up_to_the_mixture(stored):
    for own in stored.record["own"]:
        parts = stored.arrays[f"own.{own['name']}.theta.parts"]
        assert len(parts) == len(own["parts"])
        assert parts.sum(0) == pytest.approx(stored.arrays[f"own.{own['name']}.theta.density"][::2], rel=1e-4, abs=1e-6)


def test_every_statistical_value_has_its_standard_error(stored):
    rules = rules_of(dict(stored.values()), EXPERIMENT.reproduces)
    for name, (rule, pattern) in rules.items():
        if isinstance(rule, Estimate):
            assert rules[error_name(rule, pattern, name)][1] == "", name
    exact = {name for name, (rule, _) in rules.items() if isinstance(rule, Exact)}
    assert not exact & set(stored.arrays)
    for name in ("distance", "own.distance", "clamp_R.printed.counts", "map.M_R.observed"):
        assert isinstance(rules[name][0], Estimate)


def test_names_of_laws_are_unique(chapter):
    assert len({law.name for law in chapter}) == len(chapter)
