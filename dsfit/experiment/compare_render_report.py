"""The tables of a comparison on an image, for the terminal and as Markdown."""

from __future__ import annotations

import math
from typing import Any

from rich.console import Group, RenderableType

from dsfit.experiment.compare_render_curve import Time
from dsfit.experiment.compare_render_summary import reference_of, rows
from dsfit.experiment.files import number
from dsfit.experiment.race_report import seconds
from dsfit.experiment.report_tables import markdown_table, rich_table

_MARKS = {"measured": "", "extrapolated": "~", "at most": "<", "more": ">"}


def _time(found: Time) -> str:
    return _MARKS[found.how] + seconds(found.seconds) if found.how in _MARKS else "-"


def _ratio(found: Time) -> str:
    if found.how not in _MARKS or not found.seconds > 0:
        return "-"
    text = f"{found.seconds:.2g}" if found.seconds < 100 else f"{float(f'{found.seconds:.2g}'):.0f}"
    return f"{_MARKS[found.how]}{text}×"


def _percent(value: float) -> str:
    value = number(value)
    return "-" if not math.isfinite(value) else f"{100 * value:.3g} %"


def _number(value: float, digits: int = 2) -> str:
    value = number(value)
    return "-" if not math.isfinite(value) else f"{value:.{digits}f}"


def quality(result: dict[str, Any]) -> list[list[str]]:
    """Head and rows: preparation, time per direction, errors at equal time and equal samples."""
    compare = result["config"]["compare"]
    budget, samples = seconds(compare["equal_seconds"]), compare["equal_samples"]
    head = ["technique", "prepare", "direction", f"error in {budget}", "FLIP", f"error, {samples} per hit", "FLIP"]
    lines = [[*head, "slope", ""]]
    for row in rows(result):
        if row["failed"]:
            lines.append([row["name"], *["-"] * 7, f"FAILED: {row['failed']}"[:200]])
            continue
        time_, count = row["equal_time"], row["equal_samples"]
        lines.append(
            [
                row["name"], seconds(row["prepare"]), seconds(row["per_sample"]), _percent(time_["error"]),
                _number(time_["flip"], 3), _percent(count["error"]), _number(count["flip"], 3), _number(row["slope"]),
                _notes(row),
            ]
        )  # fmt: skip
    return lines


def _notes(row: dict[str, Any]) -> str:
    notes = ["FAILED: biased"] if row["biased"] else []
    if row["heavy"]:
        notes.append(f"heavy tails, {_percent(row['darker'])} too dark so far" if row["darker"] > 0 else "heavy tails")
    if number(row["light"]) > 0:
        notes.append(f"{100 * number(row['light']):.0f} % light")
    return "; ".join(notes)


def equal_error(result: dict[str, Any]) -> list[list[str]]:
    """Head and rows: times to equal error, and how many times as long others take."""
    targets = [f"{number(t):g}" for t in result["config"]["compare"]["targets"]]
    head = ["technique"]
    for target in targets:
        name = f"{100 * float(target):g} %"
        head += [f"time to {name}", "all counted", "heuristic alike", "heuristic", "uniform"]
    lines = [head]
    for row in rows(result):
        if row["failed"]:
            continue
        line = [row["name"]]
        for target in targets:
            found = row["to"][target]
            line += [_time(found["prepared"]), _time(found["counted"])]
            line += [_ratio(found[key]) for key in ("alike", "heuristic", "uniform")]
        lines.append(line)
    return lines


def caption(result: dict[str, Any]) -> str:
    """What the numbers are, how good the reference is, and how much of the machine the comparison had."""
    facts = reference_of(result)
    check, config = facts["check"], result["config"]
    agreed = "agrees" if check["verdict"] == "agree" else "DIFFERS"
    lines = [
        f"{facts['width']} x {facts['height']} pixels, {facts['subsamples']} rays each, {facts['hits']:,} hits in "
        f"{facts['covered']:,} covered pixels, {facts['strands']:,} strands, mean n {_number(facts['mean_n'], 1)}; "
        f"{config['render']['dtype']}, the BSDF {facts['backend']}.",
        f"Errors are roots of the relative mean square over covered pixels, (x - r)^2 / (r^2 + 0.01 mean r^2), without "
        f"the reference's own, which is {_percent(facts['own_error'])} ({facts['passes']} passes of "
        f"{facts['samples']} directions per hit).",
        f"Its check, {check['kind']}" + (" with light sampling" if number(check["light"]) else "")
        + f", {agreed}: {100 * number(check['difference']):+.3f} ± {100 * number(check['standard_error']):.3f} % on "
        f"the whole, largest deviation {_number(check['largest_z'], 1)} standard errors among {check['blocks']} blocks "
        f"and channels (p = {number(check['p_value']):.2g}).",
        "Times are CPU seconds of one thread: directions and shading. Rays, grid and hints, "
        f"{seconds(sum(map(number, facts['shared_seconds'].values())))}, are the same for all and not in them.",
        "prepare: training, shares, tables and compilers; all counted: with it. slope: of log error over log samples "
        "(-0.5 for random points).",
        "heuristic alike, heuristic, uniform: how many times as long (prepared) these take to the same error: the best "
        "of the chapter's with the same points and light sampling or none as in the row; the best of them with random "
        "points and no light sampling; uniform random directions.",
        "~: extrapolated by 1/t; <: at most; >: at least. heavy tails: the worst 0.1 % of the pixels make up most of "
        "the error, so it is understated, and such techniques are not compared with.",
    ]  # fmt: skip
    return "\n".join([*lines, *_watch(result)])


def _watch(result: dict[str, Any]) -> list[str]:
    cells = [cell for cell in result["cells"] if "watch" in cell]
    if not cells:
        return []
    shares = [number(cell["watch"]["cpu_share"]) for cell in cells]
    loads = [number(cell["watch"]["load"][0]) for cell in cells if cell["watch"]["load"]]
    sessions = result.get("provenance", {}).get("sessions") or [{}]
    most = max(session.get("workers") or 1 for session in sessions)
    order = "Techniques ran one after another" if most == 1 else f"{most} techniques at once disturbed each other"
    return [
        f"{order}. The process had {100 * min(shares):.0f} to {100 * max(shares):.0f} % of its core; load average "
        f"{min(loads, default=0):.1f} to {max(loads, default=0):.1f}."
    ]


def _parts(result: dict[str, Any]) -> list[tuple[str, list[list[str]]]]:
    title = result["title"] or result["name"]
    return [(title, quality(result)), (f"{title}: time to equal error", equal_error(result))]


def terminal_table(result: dict[str, Any]) -> RenderableType:
    """Both tables as rich ones, and the caption."""
    return Group(*(rich_table(*part) for part in _parts(result)), caption(result))


def markdown(result: dict[str, Any]) -> str:
    """The same as Markdown."""
    texts = [markdown_table(*part) for part in _parts(result)]
    return "\n".join([*texts, caption(result), ""])
