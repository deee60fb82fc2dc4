"""What a race comes to: one row per peer, and who wins with how much time."""

from __future__ import annotations

import math
import statistics
from dataclasses import dataclass
from typing import Any

from dsfit.experiment.files import number
from dsfit.race.curve import Curve, Reading

HEURISTICS = ("single", "chapter", "best_mix", "stream_mix")
"""Peers made of the chapter's proposals: what "best heuristic" is taken from."""
TARGETS = (0.01, 0.001)
UNDERSTATED = 2.0
"""Error that quadrature predicts over the upper end of the measured one's interval beyond which it is understated."""


@dataclass(frozen=True)
class Entrant:
    """A peer with the cells it has; `stream` or `contexts` is None where it did not run."""

    name: str
    kind: str
    uniforms: str
    prepare: float
    skipped: str | None
    stream: dict[str, Any] | None
    contexts: list[dict[str, Any]] | None
    verdicts: tuple[str, ...]

    @property
    def biased(self) -> bool:
        """Whether its estimates are off the truth in any cell."""
        return "biased" in self.verdicts

    @property
    def heavy(self) -> bool:
        """Whether its errors are understated: one estimate decides the last root mean square, or quadrature says that
        it is far larger than measured."""
        rows = [*([self.stream] if self.stream else []), *(self.contexts or [])]
        return any(heavy_tailed(row) for row in rows)

    @property
    def honest(self) -> bool:
        """Whether it may win."""
        return not self.biased and not self.heavy and self.skipped is None


def heavy_tailed(row: dict[str, Any]) -> bool:
    """Whether the errors of a stream or a context are understated; see `Entrant.heavy`."""
    last = row["points"][-1]
    predicted = math.sqrt(max(number(row.get("predicted_variance", math.nan)), 0.0) / last["samples"])
    return bool(last["rmse"]["heavy"]) or predicted > UNDERSTATED * number(last["rmse"]["high"])


def entrants(cells: list[dict[str, Any]]) -> list[Entrant]:
    """The peers of a race, in the config's order."""
    found: dict[str, list[dict[str, Any]]] = {}
    for cell in cells:
        found.setdefault(cell["peer"], []).append(cell)
    made = []
    for name, own in found.items():
        groups = {cell["group"]: cell for cell in own}
        skipped = next((cell["skipped"] for cell in own if cell.get("skipped")), None)
        prepare = [number(cell["prepare"]["seconds"]) for cell in own if "prepare" in cell]
        made.append(
            Entrant(
                name, own[0]["kind"], own[0]["uniforms"], prepare[0] if prepare else math.nan, skipped,
                groups.get("stream", {}).get("stream"), groups.get("contexts", {}).get("contexts"),
                tuple(cell["verdict"] for cell in own if "verdict" in cell),
            )
        )  # fmt: skip
    return made


def curve(entrant: Entrant, row: dict[str, Any], *, counted: bool = True, which: str = "value") -> Curve:
    """Error against time of one stream or context; `counted` says whether preparation is; `which` of the root mean
    square ("value") and the ends of its interval ("low", "high"). Beyond the measured errors, where longer estimates
    were timed, the error is taken to fall with the root of the samples."""
    points = row["points"]
    seconds = [number(p["seconds"][1] if isinstance(p["seconds"], list) else p["seconds"]) for p in points]
    before = number(row["at_seconds"]) + (entrant.prepare if counted else 0.0)
    errors = [number(p["rmse"][which]) for p in points]
    longer = row.get("scouts", [])
    beyond = [errors[-1] * math.sqrt(points[-1]["samples"] / scout["samples"]) for scout in longer]
    seconds += [number(scout["seconds"]) for scout in longer]
    return Curve(before, seconds, [*errors, *beyond], len(points))


def _time(entrant: Entrant, rows: list[dict[str, Any]], target: float, counted: bool) -> dict[str, Any]:
    """Median over rows of the time to an error, with the ends of its interval and how it was found."""
    readings: dict[str, list[Reading]] = {
        which: [curve(entrant, row, counted=counted, which=which).time_to(target) for row in rows]
        for which in ("value", "low", "high")
    }
    hows = [reading.how for reading in readings["value"]]
    how = next((h for h in ("never", "extrapolated", "at most") if h in hows), "measured")
    ends = {which: statistics.median(r.value for r in found) for which, found in readings.items()}
    return {"seconds": ends["value"], "low": ends["low"], "high": ends["high"], "how": how}


def _facts(rows: list[dict[str, Any]], contexts: int) -> dict[str, float]:
    last = [(row.get("scouts") or row["points"])[-1] for row in rows]
    seconds = [number(p["seconds"][1] if isinstance(p["seconds"], list) else p["seconds"]) for p in last]
    return {
        "at": statistics.median(number(row["at_seconds"]) for row in rows) / contexts,
        "per_sample": statistics.median(s / p["samples"] for s, p in zip(seconds, last, strict=True)) / contexts,
        "variance": statistics.median(_variance(row) for row in rows),
    }


def _variance(row: dict[str, Any]) -> float:
    """Relative variance per sample: quadrature's where there is one, else that of the longest estimates."""
    predicted, last = number(row.get("predicted_variance", math.nan)), row["points"][-1]
    return predicted if not math.isnan(predicted) else number(last["rmse"]["value"]) ** 2 * last["samples"]


def rows(result: dict[str, Any]) -> list[dict[str, Any]]:
    """One row per peer.

    Fields: `name`, `kind`, `uniforms`, `skipped`, `biased`, `heavy`, `prepare` (seconds), `subset` (contexts of the
    stream it ran on, if not all), and for "stream" and "contexts" each `at` (seconds per context), `per_sample`
    (seconds), `variance` (relative, per sample), `to`: for 1 % and 0.1 % with preparation counted ("0.01") and without
    ("0.01 prepared") `{seconds, low, high, how}`, `over_heuristic` and `over_peer`: the best heuristic's, or best
    other peer's, time to 1 % (counted for the stream, prepared for contexts) over its own.
    """
    all_ = entrants(result["cells"])
    found = []
    for entrant in all_:
        row: dict[str, Any] = {
            "name": entrant.name, "kind": entrant.kind, "uniforms": entrant.uniforms, "skipped": entrant.skipped,
            "prepare": entrant.prepare, "biased": entrant.biased, "heavy": entrant.heavy, "subset": None,
        }  # fmt: skip
        if entrant.stream:
            count = entrant.stream["contexts"]
            row["stream"] = _group(entrant, [entrant.stream], count)
            row["subset"] = entrant.stream["subset"] if entrant.stream["subset"] < count else None
        if entrant.contexts:
            row["contexts"] = _group(entrant, entrant.contexts, 1)
        found.append(row)
    for group, key in (("stream", "0.01"), ("contexts", "0.01 prepared")):
        _compare(found, group, key)
    return found


def _group(entrant: Entrant, own: list[dict[str, Any]], contexts: int) -> dict[str, Any]:
    to = {}
    for target in TARGETS:
        to[f"{target:g}"] = _time(entrant, own, target, True)
        to[f"{target:g} prepared"] = _time(entrant, own, target, False)
    return {**_facts(own, contexts), "to": to}


def _compare(found: list[dict[str, Any]], group: str, key: str) -> None:
    times = {r["name"]: r[group]["to"][key]["seconds"] for r in found if group in r}
    good = [r for r in found if group in r and not r["biased"] and not r["heavy"]]
    heuristics = [times[r["name"]] for r in good if r["kind"] in HEURISTICS]
    for row in found:
        if group not in row:
            continue
        others = [times[r["name"]] for r in good if r["name"] != row["name"]]
        own = times[row["name"]]
        row[group]["over_heuristic"] = min(heuristics, default=math.nan) / own if math.isfinite(own) else 0.0
        row[group]["over_peer"] = min(others, default=math.nan) / own if math.isfinite(own) else 0.0


def winners(result: dict[str, Any]) -> list[dict[str, Any]]:
    """Who has the least error after so many seconds: for the stream and for single contexts (geometric mean over
    them), with preparation counted and without. Peers that are biased, or whose errors are understated, do not win."""
    all_ = [e for e in entrants(result["cells"]) if e.honest]
    found = []
    for group in ("stream", "contexts"):
        for counted in (True, False):
            for budget in result["config"]["race"]["budgets"]:
                ranking = sorted(_standings(all_, group, counted, number(budget)), key=lambda entry: entry["error"])
                found.append({"group": group, "counted": counted, "budget": number(budget), "ranking": ranking[:2]})
    return found


def _standings(all_: list[Entrant], group: str, counted: bool, budget: float) -> list[dict[str, Any]]:
    found = []
    for entrant in all_:
        own = entrant.stream if group == "stream" else entrant.contexts
        if not own:
            continue
        rows_ = [own] if isinstance(own, dict) else own
        readings = [curve(entrant, row, counted=counted).error_at(budget) for row in rows_]
        if any(reading.how == "never" for reading in readings):
            continue
        error = math.exp(statistics.fmean(math.log(reading.value) for reading in readings))
        hows = [r.how for r in readings]
        how = next((h for h in ("far", "extrapolated") if h in hows), "measured")
        found.append({"name": entrant.name, "error": error, "how": how})
    return found
