"""The atlas as a table: one row per function, its worst errors over all regimes."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

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
