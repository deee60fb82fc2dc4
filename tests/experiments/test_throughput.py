"""The experiment `throughput`: timing in turn, counting, which LLVM, limits, processes of its own, pictures, tables."""

from __future__ import annotations

import importlib
import math
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest
import torch

from dsfit.figures import Data, Work
from dsfit.figures.catalogue import find
from dsfit.figures.page import Page
from dsfit.race.machine import probe

ROOT = Path(__file__).parents[2]


def script(name: str) -> ModuleType:
    return importlib.import_module(f"experiments.{name}")


def test_contenders_run_in_turn_and_rows_are_what_they_took() -> None:
    timing = script("_throughput_timing")
    order: list[str] = []

    def run(name: str, seconds: float) -> Any:
        def wait() -> None:
            order.append(name)
            timing.time.sleep(seconds)

        return wait

    contenders = [timing.Contender(name, "wait", "-", 10, run(name, s)) for name, s in (("a", 4e-3), ("b", 2e-2))]
    rows = timing.measure(contenders, seconds=0.0, least=4)
    assert order[:6] == ["a", "a", "a", "b", "b", "b"]  # prepared: once to start, once to settle, once for its length
    assert order[6:] == ["a", "b", "b", "a"] * 2
    for row, least in zip(rows, (4e-3, 2e-2), strict=True):
        assert row["rounds"] == 4
        wall = row["wall"]
        assert least <= wall["least"] <= wall["low"] <= wall["median"] <= wall["high"]
        assert row["processor"]["median"] < wall["median"]  # it slept


def test_short_calls_are_repeated_within_a_slice() -> None:
    timing = script("_throughput_timing")
    calls = [0]

    def run() -> None:
        calls[0] += 1

    (row,) = timing.measure([timing.Contender("a", "count", "-", 1, run)], seconds=0.0, least=2)
    assert calls[0] > 100
    assert 0 < row["wall"]["least"] < 1e-4


def test_quantiles_are_linear_between_numbers() -> None:
    quantile = script("_throughput_timing").quantile
    assert [quantile([1.0, 2.0, 4.0], q) for q in (0.0, 0.25, 0.5, 0.75, 1.0)] == [1.0, 1.5, 2.0, 3.0, 4.0]
    assert quantile([3.0], 0.9) == 3.0


@pytest.mark.parametrize(
    ("name", "version"),
    [
        ("/usr/lib/x86_64-linux-gnu/libLLVM.so.19.1", 19),
        ("/usr/lib/x86_64-linux-gnu/libLLVM-15.so.1", 15),
        ("/usr/lib/x86_64-linux-gnu/libLLVM-14.0.6.so.1", 14),
        ("/opt/llvm/libLLVM-20.so", 20),
        ("/opt/llvm/libLLVM.so", None),
    ],
)
def test_version_of_llvm_by_name(name: str, version: int | None) -> None:
    assert script("_throughput_mitsuba").llvm_version(name) == version


def test_old_libraries_are_never_candidates_and_the_one_asked_for_comes_first(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    mitsuba = script("_throughput_mitsuba")
    for name in ("libLLVM-14.so.1", "libLLVM-15.so", "libLLVM-16.so.1", "libLLVM.so.19.1", "libLLVM-21.so"):
        (tmp_path / name).touch()
    (tmp_path / "libLLVM.so").symlink_to(tmp_path / "libLLVM-15.so")
    monkeypatch.setattr(mitsuba, "_PLACES", (str(tmp_path / "libLLVM*.so*"),))
    monkeypatch.delenv("DRJIT_LIBLLVM_PATH", raising=False)
    found = [Path(path).name for path in mitsuba.llvm_candidates()]
    assert found == ["libLLVM-21.so", "libLLVM.so.19.1"]
    monkeypatch.setenv("DRJIT_LIBLLVM_PATH", str(tmp_path / "libLLVM.so.19.1"))
    assert Path(mitsuba.llvm_candidates()[0]).name == "libLLVM.so.19.1"
    monkeypatch.setenv("DRJIT_LIBLLVM_PATH", str(tmp_path / "libLLVM-15.so"))
    assert [Path(path).name for path in mitsuba.llvm_candidates()] == found


def test_without_llvm_the_scalar_variant_is_chosen_and_says_why(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("mitsuba")
    mitsuba = script("_throughput_mitsuba")
    monkeypatch.setattr(mitsuba, "llvm_candidates", lambda: [])
    choice = mitsuba.choose()
    assert (choice.variant, choice.llvm) == ("scalar_rgb", None)
    assert "19" in choice.reason
    mi = mitsuba.start(choice, 1)
    contenders = mitsuba.contenders(mi, 5)
    assert {c.task for c in contenders} == {"eval", "fused"}
    for contender in contenders:
        contender.run()


def test_counts_are_those_of_the_formula() -> None:
    counts = script("_throughput_counts")
    x, table = torch.rand(100), torch.rand(7, dtype=torch.float32)
    at = torch.randint(7, (100,))

    def formula() -> torch.Tensor:
        return torch.exp(x) * table[at] + torch.sqrt(x).log()

    found = counts.counted(formula, 50)
    assert found["transcendentals"] == 4  # exp and log of 100 numbers for 50 directions
    assert found["gathers"] == 2
    assert found["roots and quotients"] == 2
    assert found["other"] == 4
    assert found["operations"] == 6
    assert counts.least_bytes((x, at), (x,), 50) == (400 + 800 + 400) / 50


def test_bounds_divide_counts_by_rates() -> None:
    bounds = script("_throughput_bounds").bounds
    machine = {
        "compiled": {"exp": 2e9, "divide": 5e9, "multiply-add": 2e10},
        "gather": {"compiled": {"512 KiB": 1e9}, "eager": {"512 KiB": 3e9}, "lines": {"8 MiB": 2e8, "16 KiB": 1e9}},
        "eager": {"exp": 1.0, "sqrt": 1.0, "multiply": 1.0},
        "copy": {"memory": 4e9},
        "matrix": 1e11,
    }
    found = bounds(machine, {"transcendentals": 10, "gathers": 20, "least bytes": 40, "of exp": 3})
    assert found["transcendentals"] == 5e-9
    assert found["look-ups"] == 2e-8
    assert found["least bytes"] == 1e-8
    assert found["roots and quotients"] == found["other"] == 0
    assert bounds(machine, {"gathers": 20, "lines": 6})["look-ups"] == 3e-8


def test_probe_finds_finite_rates() -> None:
    machine = probe(1e-3, compiled=False, tables={"4 KiB": 1024})
    rates = [*machine.copy.values(), *machine.eager.values(), machine.matrix]
    rates += [machine.gather[kind]["4 KiB"] for kind in ("eager", "lines")]
    assert all(math.isfinite(rate) and rate > 1e5 for rate in rates)
    assert machine.compiled == {}


def _row(library: str, task: str, layout: str, count: int, seconds: float, threads: int = 1) -> dict[str, Any]:
    return {
        "library": library,
        "task": task,
        "layout": layout,
        "count": count,
        "threads": threads,
        "wall": {"median": 5 * seconds, "low": 3 * seconds, "high": 9 * seconds, "least": seconds},
        "processor": {"median": seconds, "low": 0.9 * seconds, "high": 1.2 * seconds, "least": 0.8 * seconds},
    }


def _data() -> dict[str, Any]:
    rows = []
    for count in (1000, 10_000):
        for task in ("eval", "log_prob", "sample", "fused"):
            rows.append(_row("Mitsuba", task, "all different", count, count / 40e6))
            rows.append(_row("kernel, compiled", task, "all different", count, count / 60e6))
            rows.append(_row("kernel, compiled", task, "16 a context", count - 8, (count - 8) / 80e6))
        rows.append(_row("kernel, compiled", "prepare", "all different", count, count / 1e6))
    limits = {"eager": {"exp": 1e9, "sqrt": 1e9, "multiply": 1e9}, "copy": {"memory": 1e10}, "matrix": 1e10}
    return {
        "load": {"before": 0.5, "after": 1.5, "cores": 2},
        "mitsuba": {"version": "3.9", "variant": "llvm_ad_rgb", "reason": "LLVM 19"},
        "rows": rows,
        "machine": {**limits, "compiled": {}, "gather": {"eager": {"8 MiB": 1e9}, "lines": {"8 MiB": 1e8}}},
        "counts": {"eval": {"transcendentals": 12.0, "gathers": 8.0}},
        "backends": {"kernel, compiled": "compiled"},
    }


def test_table_has_medians_and_ratios() -> None:
    tables = {table.name: table.markdown() for table in script("drawing.throughput").tables(Data(record=_data()))}
    assert "| eval | Mitsuba 3 hair | all different | 40 (33.3-44.4) | 40 (33.3-44.4) |" in tables["rates"]
    assert "| eval | kernel, compiled | all different | 60 (50-66.7) x1.50 | 60 (50-66.7) x1.50 |" in tables["rates"]
    assert "| eval | kernel, compiled | 16 a context | 80 (66.7-88.9) x2.00 |" in tables["rates"]
    assert "| prepare | all different | 1000.0 |" in tables["terms"]
    assert "| eval | 12, 12 | 0, 0 | 8, 8 |" in tables["limits"]


def test_pictures_are_drawn_from_data_alone() -> None:
    assert set(_drawn(_data())) == {"rates", "directions", "ratios", "limits"}


def test_without_mitsuba_there_is_no_comparison() -> None:
    data = _data()
    data["rows"] = [row for row in data["rows"] if row["library"] != "Mitsuba"]
    data["mitsuba"] = {"version": "", "variant": None, "reason": "Mitsuba is not installed"}
    assert set(_drawn(data)) == {"rates", "directions", "limits"}
    caption = script("drawing.throughput").tables(Data(record=data))[0].caption
    assert "Mitsuba is not installed" in caption


def _drawn(record: dict[str, Any]) -> dict[str, Any]:
    figures = script("drawing.throughput").figures(Data(record=record), Page(150.0))
    for figure in figures.values():
        figure.draw_without_rendering()
    return figures


def test_the_worker_has_the_threads_it_was_given(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """The frame's own process is held to one thread; what it starts is not."""
    throughput = script("throughput")
    (tmp_path / "told.py").write_text(
        "import json, os, sys\n"
        "names = ('OMP_NUM_THREADS', 'MKL_NUM_THREADS', 'OPENBLAS_NUM_THREADS')\n"
        "print('measuring')\n"
        "json.dump([os.environ[name] for name in names], open(sys.argv[2], 'w'))\n"
    )
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    monkeypatch.setattr(throughput, "worker", SimpleNamespace(__name__="told"))
    said: list[str] = []
    work = Work(tmp_path, tmp_path, said.append)
    assert throughput.in_process({"threads": 2}, work) == ["2", "2", "2"] and said == ["measuring"]
    (tmp_path / "told.py").write_text("raise SystemExit(3)")
    with pytest.raises(RuntimeError, match="ended with 3"):
        throughput.in_process({"threads": 2}, work)


@pytest.mark.slow
def test_a_small_run(tmp_path: Path) -> None:
    throughput = script("throughput")
    settings = find(ROOT, "throughput").settings((*throughput.EXPERIMENT.small, "counts=[1000]", "seconds=0.01"))
    record = throughput.compute(settings, Work(tmp_path, ROOT, print)).record
    assert {row["task"] for row in record["rows"]} >= {"eval", "log_prob", "sample", "fused", "prepare", "to_angles"}
    assert {row["threads"] for row in record["rows"]} == {1}
    assert set(record["counts"]) == {"prepare", "eval", "log_prob", "sample", "fused"}
    assert ("Mitsuba" in {row["library"].split(",")[0] for row in record["rows"]}) == bool(record["mitsuba"]["variant"])


def test_modules_do_not_load_mitsuba_when_imported() -> None:
    before = "mitsuba" in sys.modules
    script("throughput")
    assert ("mitsuba" in sys.modules) == before
