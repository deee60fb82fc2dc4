"""What methods become at a context, how they are judged, and the best mix of heuristics."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import torch

from dsfit.experiment import build, compare
from dsfit.experiment.heuristic_mix import balance_fractions, best_mix
from dsfit.experiment.judge import judge
from dsfit.experiment.methods import Plan, Setting, chapter_names, make_plan
from dsfit.experiment.reader import RawConfig
from dsfit.experiment.schema import EstimateConfig
from dsfit.experiment.validation import validate
from dsfit.mis.variance import mis_variance
from dsfit.proposals import Mixture
from dsfit.quality import excess, quadrature_nodes, reference


def setting(methods: list[dict[str, Any]], n: float = 0.0, **data: Any) -> Setting:
    config = validate(RawConfig("a", "a.toml", {"methods": methods, **data}))
    context = build.context(config, {"theta_r_deg": 30.0, "phi_r_deg": 20.0, "n": n, "v": None})
    return Setting(config, build.integrand(config), context)


def named(*kinds: dict[str, Any]) -> list[dict[str, Any]]:
    return [{"name": f"m{k}", **kind} for k, kind in enumerate(kinds)]


def plans(place: Setting) -> list[Plan]:
    return [make_plan(method, place) for method in place.config.methods]


def test_every_method_becomes_a_plan_and_is_judged_as_the_library_judges_it() -> None:
    trio = ["TT", "TRT", "uniform"]
    place = setting(
        named(
            {"kind": "uniform"},
            {"kind": "light"},
            {"kind": "single", "proposal": "M_TRT", "defensive": 0.1},
            {"kind": "heuristic_mix", "proposals": trio, "weights": [1, 0, 3], "model": "one"},
            {"kind": "heuristic_mix", "proposals": trio},
            {"kind": "heuristic_mix", "proposals": trio, "heuristic": "power"},
            {"kind": "heuristic_mix", "proposals": trio, "heuristic": "optimal"},
            {"kind": "fitted", "max_steps": 3},
        )
    )
    found = plans(place)
    assert [len(p.strategies) for p in found] == [1, 1, 2, 2, 3, 3, 3, 1]
    assert found[3].names == ["TT", "uniform"] and found[3].fractions == [0.25, 0.75]
    assert found[7].fitted and found[7].fit["steps"] <= 4
    truth = reference(place.integrand, place.context, rtol=1e-6)
    judged = judge(found, place, truth)
    for k in (0, 1, 7):
        other = excess(place.integrand, found[k].strategies[0], place.context)
        assert judged[k]["excess"] == pytest.approx(float(other.value), rel=2e-3, abs=1e-6)
        assert judged[k]["largest_weight"] == pytest.approx(float(other.largest_weight), rel=0.05)
    for k in (2, 3):
        mixture = Mixture(found[k].strategies, found[k].fractions, defensive=0.0)
        assert judged[k]["excess"] == pytest.approx(
            float(excess(place.integrand, mixture, place.context).value), rel=2e-3
        )
    fine = quadrature_nodes(place.integrand, place.context, rtol=1e-8, count=10)
    for k in (4, 5, 6):
        plan, log_p = found[k], place.log_p(found[k].strategies, fine)
        fractions = torch.tensor(plan.fractions, dtype=torch.float64)
        nodes = mis_variance(fine.value, fine.weight, log_p, fractions, plan.heuristic, model=plan.model)
        assert judged[k]["excess"] == pytest.approx(float(nodes.variance_excess), rel=2e-3, abs=1e-5)
    assert judged[5]["excess"] > judged[4]["excess"] > judged[6]["excess"]


def test_all_is_the_chapter_and_the_light() -> None:
    lobes = {"kind": "lobes", "lobes": [{"theta_deg": 20, "phi_deg": 100, "width_deg": 3}], "ambient": 0.1}
    mix = {"kind": "heuristic_mix", "weights": "best"}
    place = setting(named({"kind": "light"}, mix, {**mix, "proposals": "all"}), light=lobes)
    found = plans(place)
    light, chapter, both = judge(found, place, reference(place.integrand, place.context, rtol=1e-4))
    assert "light" in found[2].names and "light" not in found[1].names
    assert both["excess"] < min(light["excess"], chapter["excess"])


def test_methods_that_miss_a_part_or_diverge_are_infinitely_bad() -> None:
    place = setting(
        named({"kind": "single", "proposal": "front"}, {"kind": "single", "proposal": "R"}, {"kind": "uniform"})
    )
    judged = judge(plans(place), place, reference(place.integrand, place.context, rtol=1e-4))
    assert [math.isinf(j["excess"]) for j in judged] == [True, True, False]


def test_balance_fractions_are_optimal_by_their_own_proof() -> None:
    generator = torch.Generator().manual_seed(3)
    log_p = torch.randn(5, 400, generator=generator, dtype=torch.float64) * 2
    squared = torch.rand(400, generator=generator, dtype=torch.float64)
    best, gap = balance_fractions(log_p, squared, tolerance=1e-6, steps=50_000)
    assert gap <= 1e-6 and float(best.sum()) == pytest.approx(1)

    def moment(c: torch.Tensor) -> float:
        return float((squared / (c @ torch.exp(log_p))).sum())

    for _ in range(200):
        other = torch.distributions.Dirichlet(torch.full((5,), 0.5, dtype=torch.float64)).sample()
        assert moment(other) >= moment(best) * (1 - 1e-6)


def test_the_best_mix_is_not_worse_than_any_mix_by_hand() -> None:
    place = setting(named({"kind": "uniform"}), n=2.0)
    strategies = [place.proposals[name] for name in chapter_names()]
    best = best_mix(place, strategies)
    assert best.excess == min(best.tried.values()) and sum(best.fractions) == pytest.approx(1)
    log_p = place.log_p(strategies)
    for subset in ([0, 9], [3, 4, 5, 9], [10, 11, 12, 13], list(range(14))):
        for rule in ("balance", "power", "maximum", "cutoff"):
            fractions = torch.zeros(14, dtype=torch.float64)
            fractions[subset] = 1 / len(subset)
            by_hand = mis_variance(place.nodes.value, place.nodes.weight, log_p, fractions, rule)
            assert best.excess <= float(by_hand.variance_excess) * (1 + 1e-9)


def test_estimates_follow_the_prediction_and_do_not_depend_on_each_other() -> None:
    place = setting(named({"kind": "uniform"}))
    plan = plans(place)[0]
    truth = reference(place.integrand, place.context, rtol=1e-5)
    variance = judge([plan], place, truth)[0]["variance"]
    options = EstimateConfig(samples=[100, 400], repeats=100, rounds=4)

    def run(seed: int) -> dict[str, Any]:
        generator = torch.Generator().manual_seed(seed)
        return compare._estimates(plan, place.integrand, place.context, options, truth, variance, generator)

    curve = run(1)
    for point in curve["estimates"]:
        ratio = point["rmse"] / point["predicted_rmse"]
        error = point["rmse_error"] / point["predicted_rmse"]
        assert abs(ratio - 1) < 4 * error and error < 0.05
        assert point["bias"] < 4 * point["predicted_rmse"] / math.sqrt(point["repeats"])
        assert point["claimed_rmse"] == pytest.approx(point["rmse"], rel=0.2)
    assert curve["samples_to_1_percent"] == pytest.approx(variance * 1e4)
    assert curve["estimates"][0]["rmse"] == run(1)["estimates"][0]["rmse"] != run(2)["estimates"][0]["rmse"]


@pytest.mark.parametrize("uniforms", ["sobol", "stratified"])
def test_quasi_random_estimates_are_measured_not_predicted(uniforms: str) -> None:
    place = setting(named({"kind": "heuristic_mix", "proposals": ["TT", "uniform"]}))
    plan = plans(place)[0]
    truth = reference(place.integrand, place.context, rtol=1e-5)
    options = EstimateConfig(samples=[64, 1024], repeats=8, rounds=1, uniforms=uniforms)
    curve = compare._estimates(
        plan, place.integrand, place.context, options, truth, 1.0, torch.Generator().manual_seed(0)
    )
    assert all(p["rmse"] < 0.5 for p in curve["estimates"]) and math.isnan(curve["predicted_over_measured"])


def test_float32_estimates_agree_with_the_float64_reference() -> None:
    place = setting(named({"kind": "fitted", "max_steps": 0}), n=1.0)
    plan = plans(place)[0]
    truth = reference(place.integrand, place.context, rtol=1e-5)
    variance = judge([plan], place, truth)[0]["variance"]
    options = EstimateConfig(samples=[1024], repeats=16, rounds=2, dtype="float32")
    curve = compare._estimates(
        plan, place.integrand, place.context, options, truth, variance, torch.Generator().manual_seed(0)
    )
    assert 0.6 < curve["estimates"][0]["rmse"] / curve["estimates"][0]["predicted_rmse"] < 1.6


@pytest.mark.parametrize("uniforms", ["random", "sobol"])
@pytest.mark.parametrize(("heuristic", "model"), [("balance", "multi"), ("balance", "one"), ("optimal", "multi")])
def test_the_fewest_samples_suffice(uniforms: str, heuristic: str, model: str) -> None:
    mix = {"kind": "heuristic_mix", "proposals": ["TT", "uniform", "TRT"], "weights": [1, 2, 7]}
    place = setting(named({**mix, "heuristic": heuristic, "model": model}))
    plan = plans(place)[0]
    truth = reference(place.integrand, place.context, rtol=1e-3)
    options = EstimateConfig(samples=[2, 512], repeats=4, rounds=1, uniforms=uniforms)
    curve = compare._estimates(
        plan, place.integrand, place.context, options, truth, 1.0, torch.Generator().manual_seed(0)
    )
    assert len(curve["estimates"]) == 2 and all(math.isfinite(p["rmse"]) for p in curve["estimates"])


def points(*pairs: tuple[int, float]) -> list[dict[str, Any]]:
    return [{"samples": n, "rmse": e} for n, e in pairs]


def test_samples_for_one_percent() -> None:
    assert compare._samples_for([], 4.0, True) == pytest.approx(4e4)
    assert compare._samples_for([], math.inf, True) == math.inf
    measured = points((100, 0.04), (400, 0.0025))
    assert compare._samples_for(measured, 1.0, False) == pytest.approx(200, rel=1e-6)
    assert compare._samples_for(points((100, 0.04), (400, 0.02)), 1.0, False) == pytest.approx(1600, rel=1e-6)
    assert compare._samples_for(points((100, 0.005), (400, 0.002)), 1.0, False) == pytest.approx(25, rel=1e-6)


def test_seeds_differ_between_cells_and_methods() -> None:
    cells = [{"grid": {}, "context": {"n": n}} for n in range(20)]
    seeds = {compare._seed(s, cell, name) for s in (1, 2) for cell in cells for name in ("a", "b")}
    assert len(seeds) == 80 and all(0 <= s < 2**63 for s in seeds)


def test_maps_cover_the_sphere_in_degrees() -> None:
    place = setting(named({"kind": "uniform"}))
    grid, degrees = compare._map_grid(place.context)
    assert degrees["theta_deg"][[0, -1]].tolist() == [-90, 90] and degrees["phi_deg"][[0, -1]].tolist() == [-180, 180]
    density = plans(place)[0].density(grid, place.context)
    assert np.allclose(density.numpy(), 1 / (4 * math.pi))
