"""Reports: one self-contained HTML page for a run, for all experiments of `dsfit figures run`, or for a sweep."""

from __future__ import annotations

from typing import Any

__all__ = ["write_report"]


def __getattr__(name: str) -> Any:
    """Loaded when first used: the command line imports this package at every start."""
    if name != "write_report":
        raise AttributeError(f"module 'dsfit.report' has no attribute {name!r}")
    from dsfit.report.write import write_report

    return write_report
