"""Reads the Markdown that dsfit writes: headings, pipe tables and paragraphs, as blocks of a page."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import replace

from dsfit.report.page import Block, Heading, Link, Table, Text

MOST_ROWS = 1000
"""Rows of a table that a page shows."""

_SENTENCE = 30  # what is longer is no number, whatever the rule says of its column
_RULE = re.compile(r":?-+:?")
_PIPE = re.compile(r"(?<!\\)\|")
_NUMBER = re.compile(r"[~<>≤≥±+\-−]?(\d[\d.,]*([eE][+-]?\d+)?|inf|nan)?\s?[%×°a-zµ]{0,4}")


def blocks(text: str, title: str = "", links: Sequence[Link] = ()) -> list[Block]:
    """Blocks of a document; its first heading is left out if it starts with `title`, which the page has already.

    A heading right before a table is the table's caption, and paragraphs below a table are its notes. `links` go with
    every table.
    """
    found: list[Block] = []
    caption, lines = "", text.replace("\r\n", "\n").split("\n")
    for kind, part in _parts(lines):
        if kind == "heading":
            caption = _flush(found, caption)
            caption = part[0].lstrip("#").strip()
            caption = "Summary" if caption == title else caption
        elif kind == "table":
            head, rows, align = parse_table(part)
            found.append(
                Table(caption, head, rows[:MOST_ROWS], align, (), links, left_out=max(len(rows) - MOST_ROWS, 0))
            )
            caption = ""
        elif found and isinstance(found[-1], Table) and not caption:
            found[-1] = _noted(found[-1], part)
        else:
            caption = _flush(found, caption) if found or caption != "Summary" else caption
            found.append(Text(part))
    _flush(found, caption)
    return found


def _flush(found: list[Block], heading: str) -> str:
    """A heading that no table follows stands for itself."""
    if heading:
        found.append(Heading(heading))
    return ""


def _noted(table: Table, notes: Sequence[str]) -> Table:
    return replace(table, notes=(*table.notes, *notes))


def _parts(lines: Sequence[str]) -> Iterator[tuple[str, list[str]]]:
    """Consecutive lines of one kind: one heading, a table, or a paragraph's lines."""
    k = 0
    while k < len(lines):
        if not lines[k].strip():
            k += 1
        elif re.match(r"#{1,6} ", lines[k]):
            yield "heading", [lines[k]]
            k += 1
        else:
            kind = "table" if _starts_table(lines, k) else "text"
            end = k + 1
            while end < len(lines) and lines[end].strip() and (kind == "text") != lines[end].startswith("|"):
                end += 1
            yield kind, list(lines[k:end])
            k = end


def _starts_table(lines: Sequence[str], k: int) -> bool:
    if not lines[k].startswith("|") or k + 1 >= len(lines) or not lines[k + 1].startswith("|"):
        return False
    rule = split_row(lines[k + 1])
    return bool(rule) and all(_RULE.fullmatch(cell) for cell in rule)


def split_row(line: str) -> list[str]:
    """Cells of a line; a pipe after a backslash belongs to its cell."""
    line = line.strip()
    inside = line[1:-1] if line.endswith("|") and not line.endswith("\\|") and len(line) > 1 else line[1:]
    return [cell.replace("\\|", "|").strip() for cell in _PIPE.split(inside)]


def parse_table(lines: Sequence[str]) -> tuple[list[str], list[list[str]], str]:
    """Head, rows (as many cells as the head has) and alignment; columns of numbers for which the rule says nothing are
    aligned right."""
    head, rule = split_row(lines[0]), split_row(lines[1])
    width = max(len(head), len(rule))
    rows = [(row + [""] * width)[:width] for row in map(split_row, lines[2:])]
    head, rule = (head + [""] * width)[:width], (rule + ["---"] * width)[:width]
    letters = [_letter(mark, [row[k] for row in rows], first=k == 0) for k, mark in enumerate(rule)]
    return (head if any(head) else []), rows, "".join(letters)


def _letter(mark: str, cells: list[str], first: bool) -> str:
    if any(len(cell) > _SENTENCE for cell in cells):
        return "l"
    if mark.endswith(":"):
        return "c" if mark.startswith(":") else "r"
    given = [cell for cell in cells if cell not in ("", "-")]
    numbers = bool(given) and all(_NUMBER.fullmatch(cell) and any(c.isdigit() for c in cell) for cell in given)
    return "r" if numbers and not first and not mark.startswith(":") else "l"
