"""The tables of a race, for the terminal and as Markdown."""

from __future__ import annotations

import math
from typing import Any

from rich.console import Group, RenderableType

from dsfit.experiment.files import number
from dsfit.experiment.race_summary import rows, winners
from dsfit.experiment.report_tables import markdown_table, rich_table

_MARKS = {"extrapolated": "~", "at most": "<", "measured": "", "never": ""}
_TITLES = {"stream": "a stream of {contexts} contexts", "contexts": "{single} contexts, one by one (medians)"}
_HEADS = {
    "stream": (
        "peer", "prepare", "context", "sample", "variance", "time to 1 %", "time to 0.1 %", "× heuristic",
        "× other", "",
    ),
    "contexts": (
        "peer", "context", "sample", "variance", "1 %, prepared", "0.1 %, prepared", "1 %, all counted",
        "× heuristic", "× other", "",
    ),
}  # fmt: skip


def seconds(value: float) -> str:
    """A time with its unit, three digits."""
    value = number(value)
    if math.isnan(value) or math.isinf(value):
        return "-" if math.isnan(value) else "never"
    if 600 <= value < 7200:
        return f"{value / 60:.3g} min"
    if value >= 7200:
        return f"{value / 86400:.3g} days" if value >= 172800 else f"{value / 3600:.3g} h"
    value = float(f"{value:.3g}")  # 999.9 ms are 1 s, not 1e+03 ms
    for unit, size in (("s", 1.0), ("ms", 1e-3), ("us", 1e-6)):
        if value >= size:
            return f"{value / size:.3g} {unit}"
    return f"{value / 1e-9:.3g} ns" if value > 0 else "0"


def _span(reading: dict[str, Any]) -> str:
    """A time with its mark and, in the same unit, its interval."""
    value, low, high = (number(reading[key]) for key in ("seconds", "low", "high"))
    text = _MARKS[reading["how"]] + seconds(value)
    if reading["how"] == "never" or not (math.isfinite(low) and math.isfinite(high)) or high <= low * 1.005:
        return text
    size = value / float(seconds(value).split()[0])
    return f"{text} [{_two(low / size)}, {_two(high / size)}]"


def _two(value: float) -> str:
    """Two digits, without an exponent."""
    return f"{value:.2g}" if value < 100 else f"{float(f'{value:.2g}'):.0f}"


def _ratio(value: float) -> str:
    value = number(value)
    if math.isnan(value) or value == 0:
        return "-"
    return f"{value:.2g}×" if value < 100 else f"{value:.0f}×"


def _short(value: float) -> str:
    value = number(value)
    if math.isnan(value):
        return "-"
    return f"{value:.3g}" if 1e-3 <= abs(value) < 1e4 else f"{value:.1e}"


def _notes(row: dict[str, Any]) -> str:
    notes = []
    if row["biased"]:
        notes.append("FAILED: biased")
    if row["heavy"]:
        notes.append("heavy tails")
    if row["subset"]:
        notes.append(f"on {row['subset']} contexts")
    return "; ".join(notes)


def table(result: dict[str, Any], group: str) -> list[list[str]]:
    """Head and rows of one group."""
    lines = [list(_HEADS[group])]
    for row in rows(result):
        if row["skipped"]:
            lines.append([row["name"], *["-"] * (len(_HEADS[group]) - 2), f"not run: {row['skipped']}"])
        elif group in row:
            lines.append(_line(row, group))
    return lines


def _line(row: dict[str, Any], group: str) -> list[str]:
    own = row[group]
    facts = [seconds(own["at"]), seconds(own["per_sample"]), _short(own["variance"])]
    keys = ("0.01", "0.001") if group == "stream" else ("0.01 prepared", "0.001 prepared", "0.01")
    times = [_span(own["to"][key]) for key in keys]
    first = [row["name"], seconds(row["prepare"])] if group == "stream" else [row["name"]]
    ratios = [_ratio(own["over_heuristic"]), _ratio(own["over_peer"])]
    return [*first, *facts, *times, *ratios, _notes(row)]


def winner_table(result: dict[str, Any]) -> list[list[str]]:
    """Head and rows: who is best after each budget, with its error, and the next one's."""
    found = winners(result)
    budgets = sorted({entry["budget"] for entry in found})
    lines = [["", *(seconds(b) for b in budgets)]]
    for group, counted, label in (
        ("stream", True, "stream, preparation counted"),
        ("stream", False, "stream, already prepared"),
        ("contexts", True, "one context, preparation counted"),
        ("contexts", False, "one context, already prepared"),
    ):
        own = {e["budget"]: e["ranking"] for e in found if e["group"] == group and e["counted"] == counted}
        lines.append([label, *(_podium(own.get(b, [])) for b in budgets)])
    return lines


def _podium(ranking: list[dict[str, Any]]) -> str:
    if not ranking:
        return "nobody done"
    if ranking[0]["how"] == "far":
        return "not measured that far"
    texts = [f"{e['name']} {_MARKS[e['how']]}{_percent(e['error'])}" for e in ranking if e["how"] != "far"]
    return texts[0] + (f", then {texts[1]}" if len(texts) > 1 else "")


def _percent(error: float) -> str:
    return f"{100 * number(error):.2g} %"


def _title(result: dict[str, Any], group: str) -> str:
    cells = result["cells"]
    contexts = next((c["stream"]["contexts"] for c in cells if "stream" in c), 0)
    single = next((len(c["contexts"]) for c in cells if "contexts" in c), 0)
    return f"{result['title'] or result['name']}: " + _TITLES[group].format(contexts=f"{contexts:,}", single=single)


def caption(result: dict[str, Any]) -> str:
    """What the numbers are, and how much of the machine the race had."""
    cells = [cell for cell in result["cells"] if "watch" in cell]
    shares = [number(cell["watch"]["cpu_share"]) for cell in cells]
    loads = [number(cell["watch"]["load"][0]) for cell in cells if cell["watch"]["load"]]
    which = cells[0].get("implementation", "eager") if cells else "eager"
    estimate = result["config"]["estimate"]
    lines = [
        f"Errors are relative root mean squares, with 95 % intervals. Times are CPU seconds of one thread; "
        f"{estimate['dtype']}, the BSDF {which} for all peers.",
        "prepare: once; context: work at each; sample: at the longest estimates; variance: relative, of one sample "
        "(quadrature's at single contexts where the density is known). Times of the stream count everything.",
        "× heuristic, × other: time to 1 % of the best of the chapter's heuristics, and of the best other peer, over "
        "the peer's own (single contexts: prepared). ~: error extrapolated from the longest by S^-1/2; <: at "
        "most.",
        "heavy tails: rare large weights decide, the error is understated and the peer does not win. on M contexts: "
        "too slow for all of them, times scaled.",
    ]
    if shares:
        sessions = result.get("provenance", {}).get("sessions") or [{}]
        most = max(session.get("workers") or 1 for session in sessions)
        order = "Peers ran one after another. " if most == 1 else f"{most} peers at once disturbed each other. "
        lines.append(
            f"{order}The process had {100 * min(shares):.0f} to {100 * max(shares):.0f} % of its core; load average "
            f"{min(loads, default=0):.1f} to {max(loads, default=0):.1f}."
        )
    return "\n".join(lines)


def terminal_table(result: dict[str, Any]) -> RenderableType:
    """Both groups and the winners as rich tables."""
    parts: list[RenderableType] = []
    for group in ("stream", "contexts"):
        parts.append(rich_table(_title(result, group), table(result, group)))
    parts.append(rich_table("Least error after so much time", winner_table(result)))
    return Group(*parts, caption(result))


def markdown(result: dict[str, Any]) -> str:
    """The same as Markdown."""
    parts = []
    for group in ("stream", "contexts"):
        parts.append(markdown_table(_title(result, group), table(result, group)))
    parts.append(markdown_table("Least error after so much time", winner_table(result)))
    return "\n".join([*parts, caption(result), ""])
