"""The table of the chapter's errata with their measured effects.

    python experiments/errata.py                      (measures them: a minute)
    dsfit check configs/controls.toml
    python experiments/errata.py runs/controls-ID     (reads a finished run)

Prints Markdown: the section "Errata of the chapter" of the README is this table.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

from dsfit.checks.controls import CONTROLS, run
from dsfit.checks.controls.table import errata_table


def measured() -> dict[str, str]:
    """Effects by control, from the suite itself."""
    return {name: run(name, seed=1).findings[0].detail for name in CONTROLS}


def recorded(folder: Path) -> dict[str, str]:
    """Effects by control, from the result of a run of `configs/controls.toml`."""
    result = json.loads((folder / "result.json").read_text())
    found = [f for cell in result["cells"] for f in cell["findings"] if f["suite"] == "controls"]
    return {f["subject"]: f["detail"] for f in found if f["subject"] in CONTROLS and f["case"].startswith("printed")}


def main(arguments: list[str]) -> None:
    """Command line; see the module text."""
    print(errata_table(recorded(Path(arguments[0])) if arguments else measured()), end="")


if __name__ == "__main__":
    main(sys.argv[1:])
