"""Planted faults are caught by their checks, which are content without them, and the library is itself again after."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from dsfit.checks.faults import FAULTS, Patch, parts, planted, run
from dsfit.checks.suites import SUITES
from dsfit.errors import InputError

QUICK = ("jacobian-cosine", "jacobian-two", "truncation", "inverse-cdf", "mixture-choice", "random-even", "unseen-tilt")


def _passes(name: str) -> None:
    without, with_it = run(name, seed=5).findings
    assert without.value == 0, without.detail
    assert with_it.value <= with_it.bound, with_it.detail


@pytest.mark.parametrize("name", QUICK)
def test_caught(name: str) -> None:
    _passes(name)


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in FAULTS if name not in QUICK])
def test_caught_too(name: str) -> None:
    _passes(name)


def test_the_list_is_wide() -> None:
    caught = [fault for fault in FAULTS.values() if fault.caught]
    assert len({fault.module for fault in caught}) >= 20
    assert {fault.suite for fault in FAULTS.values()} <= set(SUITES)
    assert parts(["projection"]) == ["projection"]
    with pytest.raises(InputError, match="faults"):
        parts(["no such fault"])


def test_a_fault_is_seen_everywhere_and_leaves_no_trace() -> None:
    import dsfit.bsdf.attenuation as user
    import dsfit.bsdf.fresnel as home

    original = home.fresnel
    assert user.fresnel is original
    with planted([Patch("dsfit.bsdf.fresnel:fresnel", lambda f: lambda *a: "wrong")]):
        assert home.fresnel(1) == user.fresnel(1) == "wrong"
    assert home.fresnel is user.fresnel is original
    with pytest.raises(ZeroDivisionError), planted([Patch("dsfit.bsdf.fresnel:fresnel", lambda f: lambda *a: "wrong")]):
        raise ZeroDivisionError
    assert home.fresnel is original


def test_every_patch_has_a_target() -> None:
    """A fault that replaces nothing would be caught by nothing, or by chance."""
    for fault in FAULTS.values():
        for patch in fault.patches:
            module, _, path = patch.target.partition(":")
            __import__(module)
            owner = sys.modules[module]
            for part in path.split("."):
                assert part in vars(owner), patch.target
                owner = vars(owner)[part]


def test_the_readme_lists_them() -> None:
    """Rows of the table are the registered faults, in their order."""
    text = (Path(__file__).parents[2] / "README.md").read_text().split("### Planted faults")[1].split("</details>")[0]
    rows = [line.split(" | ") for line in text.splitlines() if line.startswith("| `dsfit")]
    assert [row[1].replace("\\|", "|") for row in rows] == [fault.slip for fault in FAULTS.values()]
    assert [row[2] for row in rows] == [fault.suite for fault in FAULTS.values()]
    nothing = [row[3].startswith("nothing reported") for row in rows]
    assert nothing == [not fault.caught for fault in FAULTS.values()]
