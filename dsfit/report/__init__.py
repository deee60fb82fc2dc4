"""Reports: one self-contained HTML page for a run, for all experiments of `dsfit figures run`, or for a sweep."""

from __future__ import annotations

from dsfit.report.write import write_report

__all__ = ["write_report"]
