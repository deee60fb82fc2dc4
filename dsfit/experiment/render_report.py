"""What a rendering came to: one table, on a terminal and in Markdown."""

from __future__ import annotations

import math
from typing import Any

from rich.table import Table

from dsfit.experiment.files import number
from dsfit.experiment.race_report import seconds as _time


def _percent(value: Any) -> str:
    value = number(value)
    return "-" if math.isnan(value) else f"{100 * value:.3g} %"


def rows(result: dict[str, Any]) -> list[tuple[str, str]]:
    """Name and value of everything worth telling."""
    image, render = result["image"], result["config"]["render"]
    technique, sessions = render["technique"], result["provenance"]["sessions"]
    workers = max(session.get("workers") or 1 for session in sessions)
    processes = f"{workers} process{'es' if workers > 1 else ''}"
    interrupted = f", in {len(sessions)} sittings" if len(sessions) > 1 else ""
    passes = f"{render['passes']} passes"
    if render.get("pilot"):
        passes = f"{render['pilot']} passes, then {render['passes']} more on average,"
    directions = f"{passes} of {render['samples']} directions per hit"
    pixels = image["width"] * image["height"]
    share = f" with {100 * number(technique['light']):.3g} % light sampling" if number(technique["light"]) else ""
    found = [
        ("image", f"{image['width']} x {image['height']} pixels, {_percent(image['covered'])} covered"),
        ("technique", f"{technique['kind']}{share}, {technique['uniforms']} points"),
        ("time, wall", f"{_time(image['wall_seconds'])} with {processes}{interrupted}"),
        ("time, CPU", f"{_time(image['cpu_seconds'])} ({_time(number(image['cpu_seconds']) / pixels)} per pixel)"),
        ("preparation, CPU", f"{_time(image['preparation_cpu_seconds'])}, all processes together"),
    ]
    if training := image["training"]:
        when = "by an earlier run" if training["found"] else "before the first tile"
        found.append(("training, CPU", f"{_time(training['seconds'])}, {training['steps']} steps, {when}"))
    return [
        *found,
        ("tiles", f"{image['tiles']} of at most {render['tile']} x {render['tile']} pixels"),
        ("rays", f"{image['rays']:,} ({render['subsamples']} per pixel), {image['hits']:,} meet a fibre"),
        ("samples", f"{image['samples']:,} ({directions})"),
        ("samples per CPU second", f"{image['samples'] / max(number(image['cpu_seconds']), 1e-9):,.0f}"),
        ("peak memory", f"{image['peak_memory'] / 2**20:,.0f} MiB per process"),
        ("mean n", f"{number(image['mean_n']):.3g} fibres passed by the light (hints)"),
        ("relative standard error", f"{_percent(image['relative_error'])}, mean over covered pixels"),
        ("relative RMS error", f"{_percent(image['relative_rms_error'])}, root of mean variance over mean square"),
        ("BSDF", str(image["backend"])),
        ("tone map", image["tone_map"]),
    ]


def _title(result: dict[str, Any]) -> str:
    return result["title"] or result["name"]


def caption() -> str:
    """What the numbers are, in words."""
    return (
        "Errors are those of random directions, from the spread of the passes; the rays' places in the pixels are "
        "fixed. CPU seconds are of one thread, other work on the machine does not count."
    )


def terminal_table(result: dict[str, Any]) -> Table:
    """The table for a terminal."""
    made = Table(
        title=_title(result), title_justify="left", title_style="bold", show_header=False, caption=caption(),
        caption_justify="left",
    )  # fmt: skip
    for row in rows(result):
        made.add_row(*row)
    return made


def markdown(result: dict[str, Any]) -> str:
    """The same as Markdown."""
    lines = [f"# {_title(result)}", "", "| | |", "|---|---|", *(f"| {a} | {b} |" for a, b in rows(result))]
    return "\n".join([*lines, "", caption(), ""])
