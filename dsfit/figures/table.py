"""A table that can be printed, read on a page and set in a thesis."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from dsfit.figures.latex import table


@dataclass(frozen=True)
class Table:
    """Cells as text, in rows below a head; the first column is aligned left, the others right unless `align` says so.

    Attributes:
        name: file name without suffix, unique in its experiment.
        caption: what it shows, one paragraph.
        head: names of the columns, with their units.
        rows: as many cells as the head has; plain text, no markup.
        align: a letter `l`, `r` or `c` for each column, if not as above.
    """

    name: str
    caption: str
    head: Sequence[str]
    rows: Sequence[Sequence[str]]
    align: str = ""

    def __post_init__(self) -> None:
        wrong = [k for k, row in enumerate(self.rows) if len(row) != len(self.head)]
        if wrong or len(self.alignment) != len(self.head):
            raise ValueError(f"table {self.name}: rows {wrong} or align do not fit {len(self.head)} columns")

    @property
    def alignment(self) -> str:
        """A letter for each column."""
        return self.align or "l" + "r" * (len(self.head) - 1)

    def markdown(self) -> str:
        """The table in Markdown, its caption below."""
        rule = [{"l": "---", "r": "---:", "c": ":---:"}[letter] for letter in self.alignment]
        cells = [[str(cell).replace("|", "\\|") for cell in row] for row in (self.head, *self.rows)]
        lines = [cells[0], rule, *cells[1:]]
        return "\n".join("| " + " | ".join(line) + " |" for line in lines) + f"\n\n{self.caption}\n"

    def latex(self, label: str = "") -> str:
        """The table in LaTeX with booktabs' rules, caption and label (`tab:NAME` if none is given); it takes
        `\\usepackage{array,booktabs,graphicx,longtable}`."""
        return table(self, label or f"tab:{self.name}")
