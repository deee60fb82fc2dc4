"""Tabulates planted faults: by fault, and by the suite that caught them."""

from __future__ import annotations

import math
from typing import Any

from matplotlib.figure import Figure

from dsfit.figures import Data, Table
from dsfit.figures.page import Page


def figures(data: Data, page: Page) -> dict[str, Figure]:
    """None: what was caught is a list."""
    return {}


def tables(data: Data) -> list[Table]:
    """Every fault with what its check measured, and how many each suite caught."""
    faults: list[dict[str, Any]] = data.record["faults"]
    rows = [
        [fault["module"], fault["slip"], fault["suite"], _measured(data, k, fault["where"])]
        for k, fault in enumerate(faults)
    ]
    caught = sum(fault["caught"] for fault in faults)
    caption = (
        f"{len(faults)} slips planted into the library, {caught} caught; last column: the strongest finding, as "
        "p-value or as deviation above its bound. The same checks report nothing without the slip"
        + ("." if all(fault["quiet_without"] for fault in faults) else " but where marked.")
    )
    suites = list(dict.fromkeys(fault["suite"] for fault in faults))
    counts = [
        [s, str(_count(faults, s)), str(_count(faults, s, "caught")), str(_count(faults, s, "expected"))]
        for s in suites
    ]
    by_suite = "Planted faults by the suite that is meant to catch them."
    return [
        Table("faults", caption, ["module", "slip", "check", "measured"], rows, "llll"),
        Table("suites", by_suite, ["suite", "planted", "caught", "expected to be caught"], counts),
    ]


def _count(faults: list[dict[str, Any]], suite: str, key: str = "name") -> int:
    return sum(bool(fault[key]) for fault in faults if fault["suite"] == suite)


def _measured(data: Data, k: int, where: str) -> str:
    decades, deviation, bound = (float(data.arrays[key][k]) for key in ("decades", "deviation", "bound"))
    noisy = "" if data.record["faults"][k]["quiet_without"] else " (also without the slip)"
    if not math.isnan(decades):
        p = "< 1e-300" if decades >= 300 else f"= {10**-decades:.0e}"
        return f"{where}: p {p}{noisy}"
    return where + noisy if math.isnan(deviation) else f"{where}: {deviation:.2g} > {bound:.0e}{noisy}"
