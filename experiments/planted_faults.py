"""Slips planted into the library, one by one, and the checks that catch them."""

from __future__ import annotations

import math
import re
from typing import Any

import numpy as np

from dsfit.figures import Close, Data, Experiment, Settings, Work
from experiments._check_runs import findings, names

_MOST = 300.0
_MEASURED = re.compile(r"(?P<where>.*): (?:p = (?P<p>\S+)|(?P<value>\S+) > (?P<bound>\S+))")


class PlantedFaults(Settings):
    """`faults` are slips by name, all if the list is empty; `seed` places what is drawn."""

    faults: list[str]
    seed: int


def compute(settings: PlantedFaults, work: Work) -> Data:
    """Plants each fault and runs the check that is meant for it, on the healthy library as well.

    Arrays, one value per fault: `decades` of the smallest p-value (300 at most), or `deviation` and its `bound`, of the
    strongest finding; nan where it is of the other kind, or nothing was found.
    """
    overrides = (f"check.faults.faults={names(settings.faults)}", f"estimate.seed={settings.seed}")
    found = findings(work.run("faults.toml", overrides), "faults")
    planted = [f for f in found if f["data"]]
    healthy = {f["subject"].removeprefix("not "): f["value"] == 0 for f in found if not f["data"]}
    rows, numbers = [], []
    for finding in planted:
        where, measured = strongest(finding["data"]["strongest"])
        facts = {key: finding["data"][key] for key in ("module", "slip", "suite", "expected")}
        caught = finding["data"]["failed"] > 0
        quiet = healthy.get(finding["subject"], True)
        rows.append({"name": finding["subject"], **facts, "caught": caught, "quiet_without": quiet, "where": where})
        numbers.append(measured)
    keys = ("decades", "deviation", "bound")
    return Data({key: np.array([measured[key] for measured in numbers]) for key in keys}, {"faults": rows})


def strongest(text: str) -> tuple[str, dict[str, float]]:
    """Where a fault showed most, and how much: parts of "WHERE: VALUE > BOUND" or "WHERE: p = VALUE"."""
    match = _MEASURED.fullmatch(text)
    if match is None:
        return text, {"decades": math.nan, "deviation": math.nan, "bound": math.nan}
    parts: dict[str, Any] = match.groupdict()
    if parts["p"] is not None:
        p = float(parts["p"])
        decades = min(-math.log10(p), _MOST) if p > 0 else _MOST
        return parts["where"], {"decades": decades, "deviation": math.nan, "bound": math.nan}
    return parts["where"], {"decades": math.nan, "deviation": float(parts["value"]), "bound": float(parts["bound"])}


EXPERIMENT = Experiment(
    title="Planted faults and the checks that caught them",
    shows="Which slips in the library the checks find, and the few that no check can see.",
    settings=PlantedFaults,
    compute=compute,
    minutes=1.6,
    reproduces={"decades": Close(0.15), "deviation": Close(0.1)},
    small=('faults=["back-exponent", "azimuth-half", "unseen-parameter"]',),
)
