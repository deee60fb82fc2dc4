"""The atlas as a table: one row per function, its worst errors over all regimes."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from dsfit.checks.stability.function import CLASSES

_HEAD = ("function", "float64", "its gradient", "float32", "its gradient", "naive, float64", "naive, float32", "worst")
_COLUMNS = (("float64", "value"), ("float64", "gradient"), ("float32", "value"), ("float32", "gradient"))


def atlas_table(findings: Iterable[dict[str, Any]]) -> str:
    """Markdown from the suite's findings as plain data.

    Errors are the worst relative errors over all regimes, with the regime in which the float64 value is worst; the
    naive columns are values.
    """
    rows: dict[str, list[dict[str, Any]]] = {}
    for finding in findings:
        if finding["suite"] == "stability":
            rows.setdefault(finding["subject"], []).append(finding)
    lines = ["| " + " | ".join(_HEAD) + " |", "|---|" + "---:|" * (len(_HEAD) - 2) + "---|"]
    for name, found in rows.items():
        cells = [_number(_worst(found, *column)) for column in _COLUMNS]
        cells += [_number(_worst_naive(found, dtype)) for dtype in ("float64", "float32")]
        lines.append("| " + " | ".join([f"`{name}`", *cells, _where(found)]) + " |")
    return "\n".join([*lines, ""])


def class_table(findings: Iterable[dict[str, Any]]) -> str:
    """Markdown, one row per class of regimes: the worst errors of all functions there, and whose they are."""
    rows: dict[str, list[dict[str, Any]]] = {name: [] for name in CLASSES}
    for finding in findings:
        if finding["suite"] == "stability":
            rows[finding["data"]["class"]].append(finding)
    head = ("regime", "float64", "its gradient", "float32", "its gradient")
    lines = ["| " + " | ".join(head) + " |", "|---|" + "---|" * (len(head) - 1)]
    for name, found in rows.items():
        cells = [_worst_of_all(_of(found, *column)) for column in _COLUMNS]
        lines.append("| " + " | ".join([f"{name}: {CLASSES[name]}", *cells]) + " |")
    return "\n".join([*lines, ""])


def _worst_of_all(found: list[dict[str, Any]]) -> str:
    if not found:
        return ""
    worst = max(found, key=lambda f: float(f["value"]))
    return f"{_number(float(worst['value']))} `{worst['subject']}`"


def _of(found: list[dict[str, Any]], dtype: str, quantity: str) -> list[dict[str, Any]]:
    return [f for f in found if f["data"]["dtype"] == dtype and f["data"]["quantity"] == quantity]


def _worst(found: list[dict[str, Any]], dtype: str, quantity: str) -> float | None:
    return max((float(f["value"]) for f in _of(found, dtype, quantity)), default=None)


def _worst_naive(found: list[dict[str, Any]], dtype: str) -> float | None:
    naive = [f["data"]["naive"] for f in _of(found, dtype, "value") if "naive" in f["data"]]
    return max((float(n["worst"]) for n in naive), default=None)


def _where(found: list[dict[str, Any]]) -> str:
    values = _of(found, "float64", "value")
    worst = max(values, key=lambda f: float(f["value"]), default=None)
    return worst["data"]["regime"] if worst is not None and float(worst["value"]) > 0 else ""


def _number(value: float | None) -> str:
    return "" if value is None else f"{value:.1e}" if value else "0"
