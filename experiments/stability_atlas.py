"""The tables of the stability atlas: worst errors against 50-digit arithmetic, by regime and by function.

    python experiments/stability_atlas.py                       (measures them: three minutes)
    dsfit check configs/stability.toml
    python experiments/stability_atlas.py runs/stability-ID     (reads a finished run)
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

from dsfit.checks.stability import parts, run
from dsfit.checks.stability.table import atlas_table, class_table


def measured() -> list[dict[str, Any]]:
    """Findings of the whole suite."""
    return [finding.to_dict() for part in parts() for finding in run(part).findings]


def recorded(folder: Path) -> list[dict[str, Any]]:
    """Findings of a run of `configs/stability.toml`."""
    result = json.loads((folder / "result.json").read_text())
    return [finding for cell in result["cells"] for finding in cell["findings"]]


def main(arguments: list[str]) -> None:
    """Command line; see the module text."""
    findings = recorded(Path(arguments[0])) if arguments else measured()
    print(class_table(findings))
    print(atlas_table(findings), end="")


if __name__ == "__main__":
    main(sys.argv[1:])
