"""The table of solvers on badly posed fits.

    dsfit check configs/stiff_fits.toml
    python experiments/stiff_fits.py runs/stiff_fits-ID

Prints Markdown: the table in the README is this one.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

from dsfit.checks.stiff_fits.compare import compare, markdown


def main(arguments: list[str]) -> None:
    """Command line; see the module text."""
    if len(arguments) != 1:
        raise SystemExit(__doc__)
    result = json.loads((Path(arguments[0]) / "result.json").read_text())
    print(markdown(compare(finding for cell in result["cells"] for finding in cell["findings"])))


if __name__ == "__main__":
    main(sys.argv[1:])
