"""The table of planted faults and the checks that caught them.

    dsfit check configs/faults.toml
    python experiments/planted_faults.py runs/faults-ID

Prints Markdown: the table in the README is this one.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any


def rows(folder: Path) -> list[list[str]]:
    """Module, slip, check and what it measured, of every fault of a run."""
    result = json.loads((folder / "result.json").read_text())
    found: list[dict[str, Any]] = [f for cell in result["cells"] for f in cell["findings"] if f["data"]]
    return [[f"`{f['data']['module']}`", f["data"]["slip"], f["data"]["suite"], f["data"]["strongest"]] for f in found]


def main(arguments: list[str]) -> None:
    """Command line; see the module text."""
    if len(arguments) != 1:
        raise SystemExit(__doc__)
    table = [["module", "slip", "check", "measured"], ["---"] * 4, *rows(Path(arguments[0]))]
    for row in table:
        print("| " + " | ".join(cell.replace("|", "\\|") for cell in row) + " |")


if __name__ == "__main__":
    main(sys.argv[1:])
