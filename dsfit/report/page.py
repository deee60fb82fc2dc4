"""What a page holds, as plain data; the templates decide how it looks.

A block's `kind` names the template's macro that shows it. All text is plain: markup in it is shown, not obeyed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import ClassVar, Literal

State = Literal["pass", "fail", "unclear", "none"]


@dataclass(frozen=True)
class Link:
    """A file beside the page: `href` relative to the page and quoted, `name` what is shown, `what` in words, `size` in
    words."""

    href: str
    name: str
    what: str = ""
    size: str = ""


@dataclass(frozen=True)
class Text:
    """Paragraphs."""

    paragraphs: Sequence[str]
    kind: ClassVar[str] = "text"


@dataclass(frozen=True)
class Facts:
    """Names and values."""

    rows: Sequence[tuple[str, str]]
    kind: ClassVar[str] = "facts"


@dataclass(frozen=True)
class Code:
    """A command, a config or a log, as it is; `wrap` breaks long lines instead of letting them scroll."""

    text: str
    label: str
    wrap: bool = False
    kind: ClassVar[str] = "code"


@dataclass(frozen=True)
class Picture:
    """A picture with its caption; `source` is a data URI, empty where there is no picture and `note` says why.

    Attributes:
        name: short, for people.
        caption: what one sees.
        alt: for those who do not see it.
        width, height: to show it at, in CSS pixels.
        full: the file itself, and `others` the same in other formats.
        note: how what is embedded differs from the file.
    """

    name: str
    caption: str
    alt: str
    source: str
    width: int
    height: int
    full: Link | None
    others: Sequence[Link] = ()
    note: str = ""
    kind: ClassVar[str] = "picture"


@dataclass(frozen=True)
class Table:
    """Cells as text below a head, which may be empty; `align` has a letter l, r or c for each column.

    Attributes:
        left_out: rows that the page does not show.
    """

    caption: str
    head: Sequence[str]
    rows: Sequence[Sequence[str]]
    align: str
    notes: Sequence[str] = ()
    links: Sequence[Link] = ()
    left_out: int = 0
    kind: ClassVar[str] = "table"


@dataclass(frozen=True)
class Files:
    """A list of files."""

    links: Sequence[Link]
    left_out: int = 0
    kind: ClassVar[str] = "files"


@dataclass(frozen=True)
class Verdict:
    """What became of it: a word or two, and what there is to say; `state` decides the colour and the sign."""

    state: State
    word: str
    lines: Sequence[str] = ()
    kind: ClassVar[str] = "verdict"


@dataclass(frozen=True)
class Fold:
    """Blocks that are folded away; `printed` unfolds them on paper, else they are left out there."""

    title: str
    blocks: Sequence[Block]
    printed: bool = False
    open: bool = False
    kind: ClassVar[str] = "fold"


@dataclass(frozen=True)
class Heading:
    """A heading below the section's."""

    text: str
    kind: ClassVar[str] = "heading"


Block = Text | Facts | Code | Picture | Table | Files | Verdict | Fold | Heading


@dataclass(frozen=True)
class Section:
    """A part of the page, listed in its contents; `anchor` is unique on the page, `printed` says whether it goes on
    paper."""

    anchor: str
    title: str
    blocks: Sequence[Block]
    verdict: Verdict | None = None
    printed: bool = True


@dataclass(frozen=True)
class Page:
    """A whole page.

    Attributes:
        what: what kind of page it is, above the title.
        facts: the few that everybody looks for first.
    """

    what: str
    title: str
    verdict: Verdict
    facts: Sequence[tuple[str, str]]
    sections: Sequence[Section] = field(default_factory=list)
