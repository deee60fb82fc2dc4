"""Errors against run time, the race, amortised proposals and images as experiments, from runs made up for it."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dsfit.experiment import race_summary
from dsfit.experiment.compare_render_curve import Time
from dsfit.experiment.compare_render_summary import rows
from dsfit.experiment.race_report import seconds
from dsfit.figures import Data
from dsfit.figures.verify import compare
from experiments._image_times import TIMES, pack_times, unpack_time
from experiments._race_points import pack, unpack
from experiments.image_error_time import _window
from tests.experiments.canned_runs import Canned, Run, column, data_of, drawn, entry_of

NAMES = ("error_time", "race", "amortised", "image_error_time")


def estimate(samples: int, variance: float, per_sample: float) -> dict[str, Any]:
    rmse = math.sqrt(variance / samples)
    seconds = samples * per_sample
    return {"samples": samples, "rmse": rmse, "rmse_error": rmse / 10, "seconds": [seconds, seconds, 1.1 * seconds]}


def method(name: str, excess: float, per_sample: float, fit: float | None = None) -> dict[str, Any]:
    return {
        "name": name, "kind": "x", "excess": excess, "variance": 2 * excess, "largest_weight": 3.0,
        "seconds_per_sample": per_sample, "fit": None if fit is None else {"seconds": fit},
        "estimates": [estimate(n, 2 * excess, per_sample) for n in (64, 256, 1024)],
    }  # fmt: skip


def compared() -> Run:
    """Three contexts in which the fit is 100, 50 and 200 times better than the best mix."""
    cells = []
    for k, gain in enumerate((100.0, 50.0, 200.0)):
        methods = [
            method("uniform sphere", 2.0, 1e-6), method("M_R only", 1e7, 1e-6), method("back only", 1.0, 1e-6),
            method("all, balance", 0.8, 4e-6), method("best heuristic mix", 0.2, 1e-6, 0.3),
            method("structured, not fitted", 0.02, 1e-6, 0.01), method("fitted", 0.2 / gain, 2e-6, 1.0),
        ]  # fmt: skip
        methods[4]["estimates"] = methods[4]["estimates"][k:]  # too few samples for all its strategies
        cells.append({"label": f"blond, θr {k}°, n 0", "methods": methods})
    return Run({"cells": cells})


def test_error_time_tells_times_with_the_variance_not_the_excess(tmp_path: Path) -> None:
    work = Canned({"bench_36.toml": compared()})
    data = data_of("error_time", work, tmp_path)
    assert work.asked[0].sweep.grid["fiber.preset"] == ["nonabsorbing", "blond", "brown", "black"]
    figures, tables = drawn("error_time", data)
    medians = tables["medians"]
    assert column(medians, "time to 1 %")[0] == "40 ms"  # 4 / 0.01^2 samples of a microsecond
    assert column(medians, "× best mix")[-1] == "50" and column(medians, "fit")[-1] == "1 s"
    assert "below the best heuristic mix by 50 at least, 100 in the median, 200 at most" in tables["contexts"].caption
    assert "by less than 100 in 1 of 3 contexts" in tables["contexts"].caption
    assert len(tables["contexts"].rows) == 6 and column(tables["contexts"], "best single")[0] == "1"
    assert np.isnan(data.arrays["rmse.best heuristic mix"][2, :2]).all()
    assert {axis.get_title() for axis in figures["error_time"].axes if axis.get_visible()} == {
        "median of 3 contexts", "blond, θr 0°, n 0",
    }  # fmt: skip


def rung(samples: int, error: float, seconds: float, heavy: bool = False) -> dict[str, Any]:
    rmse = {"value": error, "low": 0.9 * error, "high": 1.1 * error, "heavy": heavy}
    return {"samples": samples, "seconds": seconds, "rmse": rmse}


def peer(name: str, kind: str, scale: float, prepare: float, heavy: bool = False) -> list[dict[str, Any]]:
    base = {"peer": name, "kind": kind, "uniforms": "random", "verdict": "unbiased", "prepare": {"seconds": prepare}}
    points = [rung(n, scale / math.sqrt(n), 1e-3 * n, heavy) for n in (1, 4, 16, 64)]
    scouts = [{"samples": 256, "seconds": 0.3}]
    stream = {"at_seconds": 0.002, "contexts": 500, "subset": 500, "points": points, "scouts": scouts}
    single = [
        {
            "at_seconds": 1e-4, "predicted_variance": scale**2, "context": {"theta_r_deg": 45.0, "n": n, "v": None},
            "points": [{**p, "seconds": [p["seconds"] / 500] * 3} for p in points],
        }
        for n in (0.0, 5.0)
    ]  # fmt: skip
    return [{**base, "group": "stream", "stream": stream}, {**base, "group": "contexts", "contexts": single}]


def raced() -> Run:
    skipped = {"peer": "VEGAS+", "kind": "vegas", "uniforms": "random", "group": "stream", "skipped": "not installed"}
    cells = [
        *peer("uniform sphere", "uniform", 1.0, 0.0), *peer("M_R only", "single", 9.0, 0.01, heavy=True), skipped,
        *peer("heuristics, balance", "chapter", 0.7, 0.01), *peer("amortised, kernels", "kernel", 0.1, 5.0),
    ]  # fmt: skip
    return Run({"title": "race", "cells": cells, "config": {"race": {"budgets": [0.01, 0.1, 10.0]}}})


def test_race_points_say_what_the_cells_said() -> None:
    found = raced().found
    arrays, peers = pack(found["cells"])
    contexts = [{"theta_r_deg": 45.0, "n": n, "v": None} for n in (0.0, 5.0)]
    again = {**found, "cells": unpack(arrays, peers, contexts)}
    for old, new in zip(race_summary.rows(found), race_summary.rows(again), strict=True):
        assert old.keys() == new.keys() and old["name"] == new["name"] and old["skipped"] == new["skipped"]
        for group in {"stream", "contexts"} & old.keys():
            for key, time in old[group]["to"].items():
                assert new[group]["to"][key]["how"] == time["how"]
                assert new[group]["to"][key]["seconds"] == pytest.approx(time["seconds"], rel=1e-5)
            assert new[group]["over_peer"] == pytest.approx(old[group]["over_peer"], rel=1e-5)
    first, second = race_summary.winners(found), race_summary.winners(again)
    assert [[r["name"] for r in w["ranking"]] for w in first] == [[r["name"] for r in w["ranking"]] for w in second]


def test_race_is_drawn_and_told(tmp_path: Path) -> None:
    data = data_of("race", Canned({"race.toml": raced()}), tmp_path)
    np.testing.assert_allclose(data.arrays["first.rmse"], [1, 9, math.nan, 0.7, 0.1], rtol=1e-6)
    np.testing.assert_allclose(data.arrays["first.error"][0], 0.2 / 3.92, rtol=1e-5)
    figures, tables = drawn("race", data)
    names = column(tables["peers"], "peer")
    assert names[:3] == ["uniform sphere", "M_R only (heavy tails)", "VEGAS+"]
    assert tables["peers"].rows[2][1:] == ["not run"] * 9
    assert column(tables["ahead"], "10 s")[1].startswith("amortised, kernels")
    assert "amortised" not in column(tables["ahead"], "100 ms")[0]  # still being prepared
    marked = [line for line in figures["race"].axes[0].lines if line.get_marker() != "None"]
    dotted = [line for line in marked if line.get_linestyle() == ":"]
    assert len(dotted) == 1


def amortised() -> Run:
    theta, n = (x.ravel() for x in np.meshgrid([-80.0, -20.0, 0.0, 20.0, 80.0], [0.0, 1.0, 5.0]))
    layers, cells = {}, []
    for k, label in enumerate(("blond", "black")):
        excess = 1e-3 * (1 + k) * (1 + n)
        layers[k] = {"theta_r_deg": theta, "n": n, "v": 0 * n, "excess": excess, "start_excess": 10 * excess}
        summary = {"median": 1e-3, "p95": 2e-3, "p99": 3e-3, "worst": 4e-3 * (1 + k), "largest_weight": 2.0}
        where = {"theta_r_deg": -80.0, "n": 5.0, "v": 0.0}
        cells.append(
            {
                "label": label, "index": k, "held_out": {**summary, "where": where}, "start": summary,
                "training": {
                    "seconds": {"proposal": 3.0, "targets": 5.0, "training": 40.0}, "steps": 9, "contexts": 64,
                    "parameters": 7,
                },
                "beyond": [{"theta_r_deg": 0.0, "n": 1e4, "excess": "nan"}],
            }
        )  # fmt: skip
    return Run({"cells": cells}, layers)


def test_amortised_maps_and_table(tmp_path: Path) -> None:
    data = data_of("amortised", Canned({"amortised.toml": amortised()}), tmp_path)
    figures, tables = drawn("amortised", data)
    upper = figures["maps"].axes[1].collections[0].get_array().reshape(3, 5)
    np.testing.assert_allclose(upper, np.repeat([[2e-3], [4e-3], [12e-3]], 5, axis=1), rtol=1e-6)
    lower = figures["maps"].axes[3].collections[0].get_array().reshape(3, 5)  # v = exp(-n): only direct light is there
    np.testing.assert_allclose(lower[0].astype(float), 2e-3, rtol=1e-6)
    assert np.isnan(np.ma.filled(lower[1:].astype(float), np.nan)).all()
    assert column(tables["quantiles"], "worst") == ["0.004", "0.008"]
    assert tables["beyond"].rows == [["0°", "10000", "-", "-"]]


def technique(name: str, kind: str, error: float, uniforms: str = "random", light: float = 0.0) -> dict[str, Any]:
    def row(samples: int) -> dict[str, Any]:
        own = error / math.sqrt(samples)
        relative = {"standard_error": 0.02 * own**2}
        mean = {"difference": 0.0}
        return {
            "samples": samples,
            "seconds": 0.01 * samples,
            "error": own,
            "relative": relative,
            "mean": mean,
            "flip": 0.1,
        }

    rungs = [row(n) for n in (1, 2, 4, 8, 16)]
    return {
        "technique": name, "kind": kind, "uniforms": uniforms, "light": light, "options": {}, "biased": False,
        "heavy": kind == "single", "prepare": {"seconds": 30.0 if kind == "guided" else 0.1}, "slope": -0.5,
        "rungs": rungs, "equal_time": row(16), "equal_samples": row(16),
    }  # fmt: skip


def painted(size: int = 24) -> Run:
    techniques = [
        technique("uniform", "uniform", 1.0), technique("M_R only", "single", 8.0),
        technique("best heuristic mix", "chapter", 0.5), technique("amortised, guided", "guided", 0.2),
        technique("amortised, guided, Sobol", "guided", 0.15, "sobol"),
    ]  # fmt: skip
    generator = np.random.default_rng(1)
    radiance = 0.5 + 0.1 * generator.random((size, size, 3), dtype=np.float32)
    layers = {0: {"radiance": radiance, "variance": 1e-6 * radiance, "coverage": np.ones((size, size), np.float32)}}
    cells: list[dict[str, Any]] = [
        {
            "index": 0,
            "reference": {
                "own_error": 0.004, "eps": 1e-3, "check": {"verdict": "agree"}, "hits": 99,
                "width": size, "height": size,
            },
        }
    ]  # fmt: skip
    for k, one in enumerate(techniques, start=1):
        layers[k] = {"equal_time": radiance * np.float32(1.1)}
        cells.append({**one, "index": k})
    config = {
        "compare": {"targets": [0.1, 0.02], "crop": [0.3, 0.3, 0.7, 0.7]},
        "render": {"exposure": None, "tone_map": "srgb"},
    }
    return Run({"title": "A block", "cells": cells, "config": config}, layers)


def test_image_times_through_arrays() -> None:
    result = painted().found
    found = rows(result)
    packed = pack_times(found, result["config"]["compare"]["targets"])
    for k, row in enumerate(found):
        for j, target in enumerate(("0.1", "0.02")):
            for i, key in enumerate(TIMES):
                old, new = row["to"][target][key], unpack_time(packed[k, j, i])
                assert isinstance(new, Time) and new.how == old.how
                np.testing.assert_equal(new.seconds, old.seconds)


def test_images_are_drawn_and_told(tmp_path: Path) -> None:
    scenes = ("block_blond_constant", "ball_black_studio")
    work = Canned({f"render_{scene}.toml": painted() for scene in scenes})
    changes = ('scenes=["block_blond_constant", "ball_black_studio"]', "trained=false", "scale=0.5", "crop=10")
    data = data_of("image_error_time", work, tmp_path, changes)
    for config in work.asked:
        assert not any(one.options.get("train") for one in config.compare.techniques)
        assert config.compare.width == 56 and not config.compare.reference.technique.options.get("train")
    assert data.arrays["block_blond_constant.picture.0"].shape == (10, 10, 3)
    shown = 1e-3 * 10 ** (data.arrays["block_blond_constant.map.0"] / 255 * 4.0)
    np.testing.assert_allclose(shown, 0.1, rtol=0.03)  # every pixel is a tenth too bright
    figures, tables = drawn("image_error_time", data)
    assert set(figures) == {"curves", *(f"crops_{scene}" for scene in scenes)}
    assert column(tables["times"], "block blond constant, 10 %")[:3] == ["~1 s", "~64 s", "~250 ms"]
    ratios = {row[1]: row[2:] for row in tables["ratios"].rows if row[0] == "block blond constant, 10 %"}
    assert ratios["amortised, guided"][0] == "40 ms" and ratios["amortised, guided"][2:] == ["-", "~6.2", "~25"]
    assert column(tables["references"], "own error / %") == ["0.40", "0.40"]


def test_times_have_three_digits_and_their_unit() -> None:
    assert [seconds(x) for x in (0.99999, 0.9994, 9.999e-4, 61.0, 1e-9)] == ["1 s", "999 ms", "1 ms", "61 s", "1 ns"]


def test_windows_lie_within_the_picture() -> None:
    import torch

    assert _window(torch.Size([100, 50, 3]), [0.3, 0.3, 0.7, 0.7], 20) == (slice(40, 60), slice(15, 35))
    assert _window(torch.Size([30, 50, 3]), [0.8, 0.0, 1.0, 0.1], 40) == (slice(0, 30), slice(10, 50))


@pytest.mark.parametrize("name", NAMES)
def test_another_seed_passes_and_another_result_does_not(name: str, tmp_path: Path) -> None:
    runs = {
        "error_time": {"bench_36.toml": compared()}, "race": {"race.toml": raced()},
        "amortised": {"amortised.toml": amortised()},
        "image_error_time": {"render_block_blond_constant.toml": painted()},
    }[name]  # fmt: skip
    changes = ('scenes=["block_blond_constant"]',) if name == "image_error_time" else ()
    data = data_of(name, Canned(runs), tmp_path, changes)
    rules = entry_of(name).experiment.reproduces
    chosen, error = {
        "error_time": ("rmse.uniform sphere", "rmse_error.uniform sphere"), "race": ("first.rmse", "first.error"),
        "amortised": ("blond.trained.summary", None),
        "image_error_time": ("block_blond_constant.error", "block_blond_constant.standard_error"),
    }[name]  # fmt: skip
    step = 0.3 * data.arrays[chosen] if error is None else 2 * data.arrays[error]
    for factor, verdict in ((1, "agrees"), (5, "deviates")):
        other = Data({**data.arrays, chosen: data.arrays[chosen] + factor * step}, data.record)
        assert compare(other, data, rules)["verdict"] == verdict


@pytest.mark.slow
@pytest.mark.parametrize("name", [*NAMES, "errata", "planted_faults", "stability_atlas", "stiff_fits"])
def test_small_runs(name: str, tmp_path: Path) -> None:
    """Computed and drawn from end to end, in what the repository has room for."""
    from dsfit.figures.make import make

    entry = entry_of(name)
    done = make(entry, tmp_path, entry.experiment.small, say=lambda what: None)
    assert done["computed"] and done["drawn"]
    folder = tmp_path / name
    assert sum((folder / file).stat().st_size for file in ("data.npz", "data.json")) < 300_000
    assert list((folder / "tables").glob("*.tex"))
