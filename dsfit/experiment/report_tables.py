"""Tables of reports, in the terminal and in Markdown, from lines of text whose first is the head."""

from __future__ import annotations

from collections.abc import Iterable

from rich.table import Table


def rich_table(title: str, lines: list[list[str]]) -> Table:
    """For the terminal: the first column and those without a head are aligned left."""
    made = Table(title=title, title_justify="left", title_style="bold")
    for k, head in enumerate(lines[0]):
        made.add_column(head, justify="left" if k == 0 or not head else "right", overflow="fold")
    for line in lines[1:]:
        made.add_row(*line)
    return made


def markdown_table(title: str, lines: list[list[str]]) -> str:
    """The same with its title as a heading."""
    rule = ["---", *["---:"] * (len(lines[0]) - 1)]
    return f"# {title}\n\n" + "\n".join(map(markdown_row, [lines[0], rule, *lines[1:]])) + "\n"


def markdown_row(cells: Iterable[str]) -> str:
    """A row of a Markdown table; pipes in names do not part cells."""
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"
