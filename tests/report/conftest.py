"""Runs, a set of experiments and a browser, each made once."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from dsfit.experiment import plots, runner, summary
from dsfit.experiment.validation import load
from dsfit.report import write_report
from tests.report.configs import CONFIGS

RunOf = Callable[[str], Path]
FLAGS = (
    "--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run",
    "--disable-background-networking", "--disable-component-update", "--disable-sync",
)  # fmt: skip
NAMES = ("chromium", "chromium-browser", "google-chrome")


@pytest.fixture(scope="session")
def run_of(tmp_path_factory: pytest.TempPathFactory) -> RunOf:
    """The finished run directory of a kind, drawn and with its report; do not change it."""
    done: dict[str, Path] = {}

    def run(kind: str) -> Path:
        if kind not in done:
            folder = tmp_path_factory.mktemp(kind)
            path = folder / f"{kind}.toml"
            path.write_text(CONFIGS[kind])
            with pytest.MonkeyPatch.context() as patch:
                if kind == "amortise":
                    from dsfit.fit.amortise import unseen

                    patch.setattr(unseen, "INCLINATIONS_DEG", (-60.0, 10.0, 89.0))
                    patch.setattr(unseen, "DEPTHS", (1.0, 30.0))
                outcome = runner.run(load(path), folder / "runs", workers=0)
            plots.draw_all(outcome.directory, outcome.result)
            (outcome.directory.path / "table.md").write_text(summary.markdown(outcome.result))
            write_report(outcome.directory.path)
            done[kind] = outcome.directory.path
        return done[kind]

    return run


@pytest.fixture
def copy_of(run_of: RunOf, tmp_path: Path) -> RunOf:
    """A copy of a kind's run directory, to be damaged."""

    def copy(kind: str) -> Path:
        return Path(shutil.copytree(run_of(kind), tmp_path / kind))

    return copy


_EXPERIMENT = """
from dsfit.figures import Close, Data, Estimate, Experiment, Settings

class Tiny(Settings):
    n: int = 3

def compute(settings, work):
    return Data({}, {"values": [1.0 * k for k in range(settings.n)], "spread": 0.5})

EXPERIMENT = Experiment(
    title="NAME <i>and</i> more", shows="What NAME shows, a_f^2 & 100 %.", settings=Tiny, compute=compute, minutes=0.25,
    reproduces={"values": Close(1e-9), "spr*": Estimate("spread")},
)
"""
_DRAWING = """
from dsfit.figures import Table

def captions(data):
    return {"second": "The second figure's own caption <b>bold</b>."}

def figures(data, page):
    found = {}
    for name in ("second", "first"):
        found[name] = page.figure(0.4)
        found[name].subplots().plot(data.record["values"])
    return found

def tables(data):
    rows = [["a|b <script>", "1.0"], ["c", "-20.5"]]
    return [Table("numbers", "What the numbers are.", ["name", "value"], rows)]
"""


@pytest.fixture(scope="session")
def experiments(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Output directory of `dsfit figures` and root: of four experiments, one made, one made with other settings, one
    failed, one missing; do not change it."""
    from dsfit.figures import state
    from dsfit.figures.catalogue import find
    from dsfit.figures.make import make
    from dsfit.figures.manifest import write_manifest

    base = tmp_path_factory.mktemp("experiments")
    root, out = base / "root", base / "out"
    for folder in ("experiments/drawing", "configs/figures"):
        (root / folder).mkdir(parents=True)
    for name in ("page_failed", "page_made", "page_missing", "page_other"):
        (root / "experiments" / f"{name}.py").write_text(_EXPERIMENT.replace("NAME", name))
        (root / "experiments" / "drawing" / f"{name}.py").write_text(_DRAWING)
        (root / "configs" / "figures" / f"{name}.toml").write_text("n = 3\n")
    make(find(root, "page_made"), out, say=lambda what: None)
    make(find(root, "page_other"), out, ["n=4"], say=lambda what: None)
    (out / "page_failed").mkdir()
    (out / "page_failed" / "log.txt").write_text("begun\nValueError: </pre><script>alert(6)</script>\x1b[0m\n")
    state.write_state(out / "page_failed" / state.FAILED, {"failure": "exit 1: <b>no</b>", "at": "2026"})
    write_manifest(out)
    write_report(out, root=root)
    return out, root


@pytest.fixture(scope="session")
def browser() -> Iterator[Any]:
    """A headless browser that may write to the page's console; skips where there is none."""
    program = next((found for name in NAMES if (found := shutil.which(name))), None)
    required = os.environ.get("DSFIT_REQUIRE_BROWSER") == "1"
    try:
        from playwright.sync_api import sync_playwright
    except ImportError:
        program, sync_playwright = None, None
    if program is None or sync_playwright is None:
        missing = "playwright is not installed" if sync_playwright is None else f"none of {', '.join(NAMES)} on PATH"
        (pytest.fail if required else pytest.skip)(f"no browser: {missing}")
    with sync_playwright() as playwright:
        started = playwright.chromium.launch(executable_path=program, args=list(FLAGS))
        yield started
        started.close()
