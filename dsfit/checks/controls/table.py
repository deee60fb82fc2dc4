"""The errata as a Markdown table."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from dsfit.checks.controls import CONTROLS, SCENE, TYPOS, Control, Typo, position

HEADER = "| equation | printed | corrected | measured effect | caught by |\n|---|---|---|---|---|"


def row(cells: Iterable[str]) -> str:
    """One line of the table; bars inside a cell are escaped."""
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"


def errata_table(effects: Mapping[str, str]) -> str:
    """All errata in the order of the equations, those without effect among them.

    Args:
        effects: control's name to its measured effect; controls that are not in it are left out.
    """
    items: list[Control | Typo] = [*(c for c in CONTROLS.values() if c.name in effects), *TYPOS]
    lines = [f"Measured in: {SCENE}, if not said otherwise. ×: integral as printed over the right one.", "", HEADER]
    for item in sorted(items, key=position):
        if isinstance(item, Control):
            effect, check = f"{item.kind}: {effects[item.name]}", f"{item.check} (`{item.name}`)"
        else:
            effect, check = item.kind, ""
        lines.append(row((item.equations, item.printed, item.corrected, effect, check)))
    return "\n".join(lines) + "\n"
