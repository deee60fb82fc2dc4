"""The verdict over all findings of a `dsfit check`, as data, as tables and as Markdown."""

from __future__ import annotations

import math
from typing import Any

from rich.console import Group
from rich.table import Table
from rich.text import Text

from dsfit.checks.finding import Finding, Verdict, judge, sidak
from dsfit.checks.suites import SUITES
from dsfit.experiment.files import number

_SHOWN = 40  # failures and unclear findings that the tables list


def findings_of(cells: list[dict[str, Any]]) -> list[Finding]:
    """All findings of a run, from its stored cells."""
    found = []
    for cell in cells:
        for entry in cell["findings"]:
            numbers = {key: None if entry[key] is None else number(entry[key]) for key in ("p_value", "value", "bound")}
            found.append(Finding(**{**entry, **numbers}))
    return found


def report(cells: list[dict[str, Any]], level: float) -> dict[str, Any]:
    """One row per suite, and every finding that failed or was unclear.

    Row fields: suite, title, findings, passed, failed, unclear, least_p (of statistical findings), level (that each
    p-value is held to), closest (largest value over its bound), seconds.
    """
    judged = judge(findings_of(cells), level)
    rows = []
    for name in dict.fromkeys(cell["suite"] for cell in cells):
        mine = [(f, v) for f, v in judged if f.suite == name]
        p_values = [f.p_value for f, v in mine if f.p_value is not None and v != "unclear"]
        ratios = [f.value / f.bound for f, v in mine if f.value is not None and f.bound and v != "unclear"]
        rows.append(
            {
                "suite": name,
                "title": SUITES[name].title,
                "findings": len(mine),
                "passed": sum(v == "pass" for _, v in mine),
                "failed": sum(v == "fail" for _, v in mine),
                "unclear": sum(v == "unclear" for _, v in mine),
                "least_p": min(p_values, default=None),
                "level": sidak(level, len(p_values)) if p_values else None,
                "closest": max((r for r in ratios if not math.isnan(r)), default=None),
                "seconds": sum(number(cell["seconds"]) for cell in cells if cell["suite"] == name),
            }
        )
    listed = {verdict: [f.to_dict() for f, v in judged if v == verdict] for verdict in ("fail", "unclear")}
    verdict: Verdict = "fail" if listed["fail"] else "pass"
    return {"verdict": verdict, "level": level, "suites": rows, "failed": listed["fail"], "unclear": listed["unclear"]}


# ---- as text ----

_HEAD = ("suite", "what", "findings", "passed", "failed", "unclear", "least p", "needed p", "value/bound", "seconds")


def _row(row: dict[str, Any]) -> list[str]:
    counts = [str(row[key]) for key in ("findings", "passed", "failed", "unclear")]
    numbers = [_short(row[key]) for key in ("least_p", "level", "closest")]
    return [row["suite"], row["title"], *counts, *numbers, f"{number(row['seconds']):.1f}"]


def _short(value: Any) -> str:
    return "-" if value is None else f"{number(value):.2g}"


def _line(finding: dict[str, Any]) -> list[str]:
    if finding["p_value"] is not None:
        numbers = f"p = {_short(finding['p_value'])}"
    elif finding["value"] is not None:
        numbers = f"{_short(finding['value'])} > {_short(finding['bound'])}"
    else:
        numbers = ""
    if finding["unclear"] is not None:
        numbers = finding["unclear"]
    return [finding["suite"], finding["subject"], finding["case"], numbers, finding["detail"]]


def _lists(result: dict[str, Any]) -> list[tuple[str, list[list[str]]]]:
    """Headings and lines of what failed and what was unclear."""
    found = []
    for key, heading in (("failed", "Failed"), ("unclear", "Could not tell")):
        entries = result["report"][key]
        if entries:
            more = f", the first {_SHOWN} of them" if len(entries) > _SHOWN else ""
            found.append((f"{heading} ({len(entries)}{more})", [_line(e) for e in entries[:_SHOWN]]))
    return found


def verdict_line(result: dict[str, Any]) -> str:
    """The whole outcome in one sentence."""
    rows = result["report"]["suites"]
    total, failed, unclear = (sum(row[key] for row in rows) for key in ("findings", "failed", "unclear"))
    word = "FAILED" if failed else "passed"
    return f"{word}: {total} findings, {failed} failed, {unclear} unclear (family level {result['report']['level']:g})"


def terminal_table(result: dict[str, Any]) -> Group:
    """The report for a terminal."""
    table = Table(title=result["title"] or result["name"], title_justify="left", title_style="bold")
    for k, name in enumerate(_HEAD):
        table.add_column(name, justify="left" if k < 2 else "right", no_wrap=k != 1)
    for row in result["report"]["suites"]:
        table.add_row(*_row(row))
    parts: list[Any] = [table]
    for heading, lines in _lists(result):
        listed = Table(title=heading, title_justify="left", title_style="bold")
        for name in ("suite", "subject", "case", "measured", "detail"):
            listed.add_column(name, overflow="fold")
        for line in lines:
            listed.add_row(*map(Text, line))
        parts.append(listed)
    return Group(*parts, Text(verdict_line(result), style="bold red" if result["report"]["failed"] else "bold green"))


def markdown(result: dict[str, Any]) -> str:
    """The report as Markdown."""
    lines = [f"# {result['title'] or result['name']}", "", verdict_line(result), ""]
    lines += ["| " + " | ".join(_HEAD) + " |", "|---|---|" + "---:|" * (len(_HEAD) - 2)]
    lines += ["| " + " | ".join(_row(row)) + " |" for row in result["report"]["suites"]]
    for heading, entries in _lists(result):
        lines += ["", f"## {heading}", "", "| suite | subject | case | measured | detail |", "|---|---|---|---|---|"]
        lines += ["| " + " | ".join(x.replace("|", "\\|") for x in entry) + " |" for entry in entries]
    return "\n".join([*lines, ""])
