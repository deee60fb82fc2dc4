"""pbrt scene files as a sequence of directives with their arguments."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from dsfit.errors import InputError
from dsfit.render.geometry.reading import open_file

MOST_BYTES = 2**30
"""Longest file that is read: 1 GiB."""
_TOKEN = re.compile(r'\s+|#[^\n]*|(?P<list>\[[^][#"]*\])|(?P<word>"[^"\n]*"|[][]|[^][\s"#]+)')
_NUMBER = re.compile(r"[-+]?(?:\d+(?:\.\d*)?|\.\d+)(?:[eE][-+]?\d+)?", re.ASCII)
_NAME = re.compile(r"[A-Za-z_]\w*", re.ASCII)
_TRUTH = ("true", "false")


class Source:
    """The text of a file, and errors that name the line."""

    def __init__(self, path: str | Path) -> None:
        allowed = f"a pbrt scene file in text form, at most {MOST_BYTES} bytes"
        file, size = open_file(path, allowed)
        with file:
            if size > MOST_BYTES:
                raise InputError(str(path), f"{size} bytes", allowed)
            self.path, self.text = path, file.read(MOST_BYTES).decode("utf-8", errors="replace")

    def error(self, position: int, what: str, value: object, allowed: str) -> InputError:
        """The error for something at this place in the text."""
        line = self.text.count("\n", 0, position) + 1
        return InputError(f"{self.path}, line {line}: {what}", value, allowed)

    def tokens(self) -> Iterator[tuple[int, str, bool]]:
        """(position, text, whether it is a list without strings and comments, brackets left off)."""
        position, text, match = 0, self.text, _TOKEN.match
        while position < len(text):
            found = match(text, position)
            if found is None:
                raise self.error(position, "text", text[position : position + 20], 'a string closed by " on its line')
            kind = found.lastgroup
            if kind == "list":
                yield position, found.group()[1:-1], True
            elif kind == "word":
                yield position, found.group(), False
            position = found.end()

    def number(self, position: int, text: str) -> float:
        """A finite number as pbrt writes it."""
        if not _NUMBER.fullmatch(text) or (value := float(text)) in (float("inf"), -float("inf")):
            raise self.error(position, "value", text, "a finite number")
        return value

    def directives(self) -> Iterator[tuple[int, str, list[Any]]]:
        """(position, name, arguments): numbers as floats, strings as str, lists as list, true and false as bool."""
        place, name, arguments = 0, "", []
        open_list: list[Any] | None = None
        for position, text, is_list in self.tokens():
            target = arguments if open_list is None else open_list
            if is_list:
                if open_list is not None:
                    raise self.error(position, "list", "[", "lists that hold no lists")
                target.append([self.value(position, item) for item in text.split()])
            elif text == "[":
                if open_list is not None:
                    raise self.error(position, "list", "[", "lists that hold no lists")
                open_list = []
            elif text == "]":
                if open_list is None:
                    raise self.error(position, "list", "]", "] only after [")
                arguments.append(open_list)
                open_list = None
            elif open_list is None and text not in _TRUTH and _NAME.fullmatch(text):
                if name:
                    yield place, name, arguments
                place, name, arguments = position, text, []
            else:
                target.append(self.value(position, text))
            if not name:
                raise self.error(position, "text", text, "a directive, such as Shape or AttributeBegin")
        if open_list is not None:
            raise self.error(len(self.text), "list", "the end of the file", "] to close the list")
        if name:
            yield place, name, arguments

    def value(self, position: int, text: str) -> Any:
        """A string, a truth value or a number."""
        if text[0] == '"':
            return text[1:-1]
        return text == "true" if text in _TRUTH else self.number(position, text)

    def parameters(self, position: int, arguments: list[Any]) -> dict[str, tuple[str, list[Any]]]:
        """Parameter lists: name -> (type, values), of arguments "type name" values "type name" values."""
        found: dict[str, tuple[str, list[Any]]] = {}
        index = 0
        while index < len(arguments):
            declared = arguments[index].split() if isinstance(arguments[index], str) else []
            if len(declared) != 2 or index + 1 >= len(arguments):
                allowed = 'pairs such as "float width" [ 0.01 ]'
                raise self.error(position, "parameter", arguments[index], allowed)
            values = arguments[index + 1]
            if declared[1] in found:
                raise self.error(position, "parameter", declared[1], "each parameter once")
            found[declared[1]] = (declared[0], values if isinstance(values, list) else [values])
            index += 2
        return found
