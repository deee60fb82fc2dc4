"""Every technique estimates the same picture, whatever it draws from and however it combines."""

from __future__ import annotations

import pytest
import torch

import dsfit
from dsfit.errors import InputError
from dsfit.race.density import DensitySampler
from dsfit.render.adaptive import allocate, render_adaptive
from dsfit.render.camera import Camera
from dsfit.render.geometry import block
from dsfit.render.geometry.view import suggested_view
from dsfit.render.integrator import Accumulated, render_tile
from dsfit.render.scene import RenderScene
from dsfit.render.techniques import TECHNIQUES, technique
from dsfit.render.techniques.mixed import MixSampler
from dsfit.render.techniques.split import ChosenSampler, SplitSampler
from dsfit.scene import ConstantLight
from dsfit.scene.lights.sphere import SphereLight
from dsfit.scene.lights.total import TotalLight
from tests.render import support_render as support

SMALL = {"proposals": ["M_TT", "R", "TRT", "MG_TT", "uniform"]}
CASES = [
    ("uniform", {}, 0.0),
    ("light", {}, 0.0),
    ("single", {"proposal": "TT", "defensive": 0.2}, 0.3),
    ("chapter", SMALL, 0.0),
    ("chapter", {**SMALL, "heuristic": "power"}, 0.25),
    ("chapter", {**SMALL, "heuristic": "maximum", "model": "one"}, 0.25),
    ("chapter", {**SMALL, "heuristic": "cutoff", "model": "one"}, 0.0),
    ("deon_offset", {"light_model": "one"}, 0.25),
    ("ou_cauchy", {"light_heuristic": "power"}, 0.25),
    ("table_2d", {"resolution": [32, 32]}, 0.5),
    ("structured", {}, 0.5),
    ("amortised", {}, 0.25),
    ("best_mix", {"hits": 8, "samples": 8}, 0.0),
    ("guided", {}, 0.0),
    ("guided", {"lights": 8, "steps": 1}, 0.25),
    ("guided", {"lights": 0, "rows": 4, "columns": 6}, 0.3),
]


def centred(found, truth, resolution: float) -> bool:
    """Whether a pixel agrees with the truth within 4 standard errors; fails if these are large."""
    error = found.variance[0, 0].sqrt()
    assert float((error / truth).max()) < resolution, "too noisy to tell"
    return bool(((found.radiance[0, 0] - truth).abs() < 4 * error + 5e-4 * truth).all())


@pytest.mark.parametrize("uniforms", ["random", "sobol"])
@pytest.mark.parametrize(("kind", "options", "light"), CASES)
def test_every_technique_is_unbiased(kind, options, light, uniforms):
    around = "lobe" if light or kind in ("light", "best_mix", "guided") else "furnace"  # what it can do well with
    scene, truth = support.scene(support.lit(around), all_rays=True), support.pixel_truth(around)
    made = technique(kind, options, light=light, uniforms=uniforms)
    found = render_tile(scene, made, *support.PIXEL, samples=512, passes=24, seed=5)
    assert centred(found, truth, 0.03)
    assert made.prepare_seconds >= 0


@pytest.mark.parametrize(("model", "light"), [("multi", 0.25), ("one", 0.25)])
def test_the_optimal_heuristic(model, light):
    scene, truth = support.scene(support.lit("lobe"), all_rays=True), support.pixel_truth("lobe")
    made = technique("chapter", {**SMALL, "heuristic": "optimal", "model": model}, light=light)
    found = render_tile(scene, made, *support.PIXEL, samples=2048, passes=8, seed=5)
    assert centred(found, truth, 0.03)


@pytest.mark.slow
def test_proposals_fitted_to_two_hits():
    scene, truth = support.scene(support.lit("furnace"), all_rays=True), support.pixel_truth("furnace")
    made = technique("fitted", {"max_steps": 20})
    found = render_tile(scene, made, *support.PIXEL, samples=256, passes=16, seed=5)
    assert centred(found, truth, 0.01)
    start = render_tile(scene, technique("structured"), *support.PIXEL, samples=256, passes=16, seed=5)
    assert float(found.variance.sum()) < float(start.variance.sum())


@pytest.mark.parametrize("light", [0.0, 0.3])
def test_few_samples_choose_their_strategy(light):
    scene = support.scene(support.lit("lobe"), all_rays=True, subsamples=16)
    made = technique("amortised", light=light) if light else technique("best_mix", {"hits": 8, "samples": 8})
    truth = render_tile(scene, technique("amortised", light=0.5), range(4), range(6), samples=128, passes=4, seed=3)
    found = render_tile(scene, made, range(4), range(6), samples=1, passes=64, seed=2)
    error = (found.variance + truth.variance).sum((0, 1)).sqrt()
    apart = (found.radiance - truth.radiance).sum((0, 1)).abs()
    assert float((error / truth.radiance.sum((0, 1))).max()) < 0.02 and bool((apart < 4 * error).all())


def test_shares_of_one_hit_differ_from_another_s():
    scene = support.scene(support.lit("furnace"), all_rays=True)
    made = technique("uniform").prepare(scene)
    hits = scene.hits(*support.PIXEL)
    contexts = scene.contexts(hits)
    made.at(hits, contexts)
    both = [technique("uniform").prepare(scene), technique("amortised").prepare(scene)]
    parts = [each.peer.at(contexts).distribution for each in both]
    shares = torch.tensor([[0.9, 0.2], [0.1, 0.8]])
    sampler = MixSampler(made.problem, parts, shares, contexts, "balance", "one")
    omega = torch.tensor([[[0.1, 0.3], [0.1, 0.3]]])
    expected = sum(shares[k] * torch.exp(parts[k].log_prob(omega)) for k in range(2))
    torch.testing.assert_close(torch.exp(sampler.log_prob(omega)), expected)
    exact = dsfit.reference(scene.integrand(hits, exact=True), contexts, 1e-5).value
    with torch.no_grad():
        runs = torch.stack([sampler.estimate(256, torch.Generator().manual_seed(k)) for k in range(60)])
    error = runs.std(0) / 60**0.5
    assert bool(((runs.mean(0) - exact).abs() < 4 * error + 5e-4 * exact).all())
    assert float((error / exact).max()) < 0.02


@pytest.mark.parametrize(("samples", "runs"), [(2, 700), (6, 200), (8, 150)])
def test_split_numbers_of_samples_are_unbiased(samples, runs):
    """Whole numbers and rounded ones, from hits with both strategies and with light alone."""
    scene = support.scene(support.lit("lobe"), all_rays=True)
    made = technique("guided").prepare(scene)
    hits = scene.hits(*support.PIXEL)
    contexts = scene.contexts(hits)
    chosen = made.at(hits, contexts)
    choice = torch.arange(len(hits)) % 2
    light = made.peer.light
    sampler = SplitSampler(made.problem, chosen.many.lobes, light, [0.25, 1.0], choice, contexts)
    exact = dsfit.reference(scene.integrand(hits, exact=True), contexts, 1e-5).value
    with torch.no_grad():
        found = torch.stack([sampler.estimate(samples, torch.Generator().manual_seed(k)) for k in range(runs)])
    error = found.std(0) / runs**0.5
    assert bool(((found.mean(0) - exact).abs() < 4 * error + 5e-4 * exact).all())
    assert float((error / exact).max()) < 0.08


def test_fits_are_made_when_there_are_samples_enough():
    scene = support.scene(support.lit("lobe"), all_rays=True)
    made = technique("guided").prepare(scene)
    hits = scene.hits(*support.PIXEL)
    contexts = scene.contexts(hits)
    sampler = made.at(hits, contexts)
    alone = ChosenSampler(sampler.few, lambda: pytest.fail("fitted for nothing"), float("inf"))
    split = ChosenSampler(sampler.few, lambda: sampler.many, 4)
    for samples, same in ((3, sampler.few), (4, sampler.many)):
        one, two, three = (x.estimate(samples, torch.Generator().manual_seed(1)) for x in (split, same, alone))
        assert torch.equal(one, two) and torch.equal(one, three) == (samples == 3)


@pytest.mark.parametrize(("light", "kind"), [("lobe", MixSampler), ("sun", DensitySampler)])
def test_few_samples_are_drawn_from_what_does_best(light, kind):
    """Light alone under a sun, where the lobes find next to nothing; both under a light as wide as they are."""
    scene = support.scene(support.lit(light), all_rays=True)
    made = technique("guided").prepare(scene)
    hits = scene.hits(*support.PIXEL)
    few = made.at(hits, scene.contexts(hits)).few
    assert type(few) is kind and (made.peer.plain == 1) == (kind is DensitySampler)
    with torch.no_grad():
        found = torch.stack([few.estimate(16, torch.Generator().manual_seed(k)).mean(0) for k in range(200)])
    error, exact = found.std(0) / 200**0.5, support.pixel_truth(light)
    assert bool(((found.mean(0) - exact).abs() < 4 * error + 5e-4 * exact).all())
    assert float((error / exact).max()) < 0.02


def test_guided_lobes_follow_the_light_that_comes_through():
    """In a block of hair light reaches a visible fibre mostly from the camera's side."""
    strands = block(seed=1, strands=1200, points=12)
    position, target, up, fov = suggested_view(strands)
    camera = Camera(position, target, up, fov_deg=fov, width=24, height=24)
    bsdf = support.scene(support.lit("furnace")).bsdf
    scene = RenderScene.of(strands, camera, bsdf=bsdf, light=ConstantLight(1.0), grid=24, subsamples=2)
    found = {
        kind: render_tile(scene, technique(kind), range(4, 20), range(4, 20), samples=16, passes=8, seed=1)
        for kind in ("amortised", "guided")
    }
    inside = found["guided"].coverage == 1
    assert int(inside.sum()) > 100
    spread = [(tile.variance.sum(-1) / tile.radiance.square().sum(-1))[inside] for tile in found.values()]
    assert float(spread[1].mean()) < 0.6 * float(spread[0].mean())
    apart = (found["guided"].radiance - found["amortised"].radiance).sum()
    error = sum(float(tile.variance.sum()) for tile in found.values()) ** 0.5 * 3**0.5
    assert abs(float(apart)) < 4 * error < 0.05 * float(found["guided"].radiance.sum())


def test_nearby_lights_are_seen_from_every_hit():
    near = SphereLight((1.5, 1.0, 1.5), 0.6, 4.0)
    scene = support.scene(TotalLight([near, ConstantLight([0.1, 0.1, 0.1])]), all_rays=True, subsamples=4)
    found = [
        render_tile(scene, technique(kind, {}, light=light), range(4), range(6), samples=64, passes=8, seed=2)
        for kind, light in (("guided", 0.0), ("uniform", 0.5), ("best_mix", 0.0))
    ]
    sums = [tile.radiance.sum((0, 1)) for tile in found]
    errors = [tile.variance.sum((0, 1)).sqrt() for tile in found]
    for one, error in zip(sums[1:], errors[1:], strict=True):
        both = (errors[0].square() + error.square()).sqrt()
        assert bool(((one - sums[0]).abs() < 4 * both).all()) and float((both / sums[0]).max()) < 0.02
    assert float(found[0].variance.sum()) < 0.5 * float(found[1].variance.sum())


def test_best_mix_is_better_than_equal_shares():
    scene = support.scene(support.lit("lobe"), all_rays=True, subsamples=4)
    best = technique("best_mix", {"hits": 24, "samples": 16}).prepare(scene)
    chosen = best.peer.chosen
    assert abs(sum(chosen.shares.values()) - 1) < 1e-9 and chosen.shares["light"] > 0.1
    assert chosen.tried[f"{chosen.heuristic}, {chosen.model}"] == min(chosen.tried.values())
    tiles = [
        render_tile(scene, made, range(4), range(6), samples=64, passes=4, seed=1)
        for made in (best, technique("chapter", light=1 / 15))
    ]
    assert float(tiles[0].variance.sum()) < 0.6 * float(tiles[1].variance.sum())


def test_a_trained_proposal_is_used():
    bsdf = support.scene(support.lit("furnace")).bsdf
    worse = dsfit.AmortisedProposal(bsdf)
    with torch.no_grad():
        for parameter in worse.parameters():
            parameter.add_(0.5)
    scene = support.scene(support.lit("furnace"), all_rays=True)
    tiles = [
        render_tile(scene, technique("amortised", options), range(4), range(6), samples=16, passes=4, seed=1)
        for options in ({}, {"proposal": worse})
    ]
    assert float(tiles[1].variance.sum()) > 1.2 * float(tiles[0].variance.sum())
    apart = (tiles[0].radiance - tiles[1].radiance).sum()
    assert abs(float(apart)) < 4 * sum(float(tile.variance.sum()) for tile in tiles) ** 0.5 * 3**0.5


def test_bad_techniques():
    assert "kernel" not in TECHNIQUES
    cases = [
        ("nothing", {}, {}, "technique"),
        ("uniform", {"x": 1}, {}, "uniform.x.*no options"),
        ("single", {"light_model": "one"}, {}, "light_model"),
        ("single", {"light_model": "some"}, {"light": 0.5}, "light_model"),
        ("single", {"light_heuristic": "optimal"}, {"light": 0.5}, "light_heuristic"),
        ("uniform", {}, {"light": 1.0}, "light"),
        ("uniform", {}, {"uniforms": "stratified"}, "uniforms"),
        ("guided", {"steps": 0}, {}, "guided.steps"),
        ("best_mix", {"samples": 1}, {}, "best_mix.samples"),
        ("amortised", {"proposal": 3}, {}, "amortised.proposal"),
    ]
    for kind, options, more, message in cases:
        with pytest.raises(InputError, match=message):
            technique(kind, options, **more)
    exact = support.scene(support.lit("furnace"), dtype=torch.float64)
    with pytest.raises(InputError, match="guided.*float32"):
        technique("guided").prepare(exact)


def test_adaptive_passes_are_unbiased_and_their_variance_is_right():
    scene = support.scene(support.lit("furnace"), all_rays=True, width=3, height=3)
    made, where = technique("uniform"), (range(3), range(3))
    options = {"samples": 2, "pilot": 3, "passes": 4}
    runs = [render_adaptive(scene, made, *where, seed=k, **options) for k in range(120)]
    value = torch.stack([run.radiance for run in runs])
    truth = render_tile(scene, technique("amortised"), *where, samples=1024, passes=8, seed=9)
    error = (value.var(0) / len(runs) + truth.variance).sqrt()
    assert float((error / truth.radiance).mean()) < 0.05
    assert float(((value.mean(0) - truth.radiance).abs() / error).max()) < 4.5
    ratio = torch.stack([run.variance for run in runs]).mean(0) / value.var(0)
    assert 0.75 < float(ratio.mean()) < 1.3
    directions = torch.stack([run.samples for run in runs]).double().sum((1, 2)) / (9 * 2 * 2)
    assert 5 < float(directions.mean()) < 9


def test_passes_go_where_neighbours_are_noisy():
    counts = torch.full((9, 9), 4)
    counts[:, 0] = 0
    mean, variance = torch.ones(81, 3, dtype=torch.float64), torch.full((81, 3), 1e-4, dtype=torch.float64)
    loud = variance.clone().reshape(9, 9, 3)
    loud[:, 5:] *= 100
    hint = torch.zeros(81)
    even = allocate(Accumulated(mean, variance, hint), counts, 4, 8, 8.0).reshape(9, 9)
    assert bool((even[:, 1:] == 8).all())
    found = allocate(Accumulated(mean, loud.reshape(81, 3), hint), counts, 4, 8, 8.0).reshape(9, 9)
    assert bool((found[:, 7:] == 16).all()) and bool((found[:, 1:4] == 2).all())
    single = variance.clone()
    single[40] *= 1e6
    own = allocate(Accumulated(mean, single, hint), counts, 4, 8, 8.0).reshape(9, 9)
    assert int(own[4, 4]) < int(own[4, 5])  # a pixel's own pilot does not decide
