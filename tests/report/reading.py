"""A page as a parser sees it."""

from __future__ import annotations

from dataclasses import dataclass, field
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

VOID = {"meta", "link", "img", "br", "hr", "input"}


@dataclass
class Parsed(HTMLParser):
    """Tags with their attributes, in order, and the text outside of style and script.

    Attributes:
        wrong: end tags that close something else.
    """

    tags: list[tuple[str, dict[str, str]]] = field(default_factory=list)
    text: str = ""
    wrong: list[str] = field(default_factory=list)
    open: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        super().__init__(convert_charrefs=True)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Keep it."""
        self.tags.append((tag, {name: value or "" for name, value in attrs}))
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        """It must close the last one that is open."""
        if not self.open or self.open[-1] != tag:
            self.wrong.append(f"</{tag}> at {self.getpos()} in {self.open[-3:]}")
        else:
            self.open.pop()

    def handle_data(self, data: str) -> None:
        """Keep what is read."""
        if not self.open or self.open[-1] not in ("style", "script"):
            self.text += data

    def all(self, tag: str) -> list[dict[str, str]]:
        """Attributes of every tag of this name."""
        return [attributes for name, attributes in self.tags if name == tag]


def parse(page: Path) -> Parsed:
    """Read a page; it must be UTF-8 and its tags must be nested."""
    found = Parsed()
    found.feed(page.read_bytes().decode("utf-8"))
    found.close()
    assert not found.wrong and not found.open
    return found


def check_references(page: Path) -> list[Path]:
    """Every reference is to the page itself, to data in it, or to a file that is there; returns those files."""
    found, files = parse(page), []
    anchors = {attributes["id"] for _, attributes in found.tags if "id" in attributes}
    for tag, attributes in found.tags:
        assert "srcset" not in attributes and "style" not in attributes
        assert not [name for name in attributes if name.startswith("on")]
        if "src" in attributes:
            assert tag == "img" and attributes["src"].startswith("data:image/")
        target = attributes.get("href")
        if target is None or target == "data:,":
            continue
        if target.startswith("#"):
            assert target[1:] in anchors
            continue
        parts = urlsplit(target)
        assert not parts.scheme and not parts.netloc and not parts.path.startswith("/"), target
        files.append(page.parent / unquote(parts.path))
        assert files[-1].exists(), target
    return files
