"""Reads experiment configs: TOML files joined by `extends`, changed by `--set`, with a record of where every key came
from."""

from __future__ import annotations

import copy
import difflib
import tomllib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from dsfit.errors import InputError

COMMAND_LINE = "--set"


class ConfigError(InputError):
    """A config that cannot be used: names the file (or `--set`), the dotted key, the value and what is allowed.

    Args:
        source: file that the offending value was written in, or `--set`.
        field: dotted key, or "(file)" if the file as a whole cannot be read.
        value: the offending value.
        allowed: what would have been accepted.
    """

    def __init__(self, source: str, field: str, value: object, allowed: str) -> None:
        super().__init__(field, value, allowed)
        self.source = source
        self.args = (f"{source}: {self.args[0]}",)


Key = tuple[str | int, ...]


@dataclass
class RawConfig:
    """Merged but unvalidated config.

    Attributes:
        name: file name without suffix; becomes part of the run directory's name.
        path: the file asked for.
        data: nested tables as `tomllib` gives them, without `extends`.
        sources: for every key that was written, the file (or `--set`) that wrote it last.
    """

    name: str
    path: str
    data: dict[str, Any]
    sources: dict[Key, str] = field(default_factory=dict)

    def source(self, key: Sequence[str | int]) -> str:
        """Where `key`, or the closest table around it, was written."""
        for length in range(len(key), 0, -1):
            if tuple(key[:length]) in self.sources:
                return self.sources[tuple(key[:length])]
        return self.path

    def lookup(self, key: Sequence[str | int]) -> Any:
        """Value at `key`, or None where nothing was written."""
        value: Any = self.data
        for part in key:
            try:
                value = value[part]
            except (KeyError, IndexError, TypeError):
                return None
        return value

    def error(self, key: Sequence[str | int], allowed: str, value: Any = None) -> ConfigError:
        """The error for `key`; the value shown is the one that was written unless another is given."""
        shown = self.lookup(key) if value is None else value
        return ConfigError(self.source(key), dotted(key), shown, allowed)

    def copy(self) -> RawConfig:
        """A copy that can be changed."""
        return RawConfig(self.name, self.path, copy.deepcopy(self.data), dict(self.sources))


def dotted(key: Sequence[str | int]) -> str:
    """Key parts as one dotted key; parts that contain a dot are quoted as in TOML."""
    return ".".join(f'"{part}"' if isinstance(part, str) and "." in part else str(part) for part in key) or "(file)"


def did_you_mean(word: str, known: Iterable[str]) -> str:
    """` (did you mean 'x'?)` or nothing."""
    close = difflib.get_close_matches(str(word), list(known), n=1)
    return f" (did you mean {close[0]!r}?)" if close else ""


def read(path: str | Path, overrides: Sequence[str] = ()) -> RawConfig:
    """Read a TOML file, everything it extends, and `key=value` overrides.

    Tables merge key by key; anything else (lists too) is replaced. What a file extends comes first, in the order
    listed, then the file itself, then the overrides.

    Raises:
        ConfigError: a file is missing or not TOML, `extends` runs in a circle, or an override cannot be applied.
    """
    raw = RawConfig(Path(path).stem, str(path), {})
    try:
        _read_into(raw, Path(path), [], str(path))
        for override in overrides:
            apply_override(raw, override)
        copy.deepcopy(raw.data)
    except RecursionError:
        raise ConfigError(str(path), "(file)", "tables within tables without end", "a few levels of tables") from None
    return raw


def _load(path: Path, named_by: str, stack: list[Path]) -> dict[str, Any]:
    shown = str(path)
    try:
        content = path.read_bytes()
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        source, key = (named_by, "extends") if stack else (shown, "(file)")
        raise ConfigError(source, key, shown, f"a readable TOML file ({reason})") from None
    try:
        return tomllib.loads(content.decode("utf-8"))
    except UnicodeDecodeError as error:
        raise ConfigError(shown, "(file)", content[error.start : error.end], "text in UTF-8") from None
    except (tomllib.TOMLDecodeError, RecursionError, ValueError) as error:
        raise ConfigError(shown, "(file)", str(error)[:100], "valid TOML") from None


def _read_into(raw: RawConfig, path: Path, stack: list[Path], named_by: str) -> None:
    try:
        resolved = path.resolve()
    except (OSError, ValueError):
        resolved = path
    if resolved in stack:
        circle = " -> ".join(p.name for p in [*stack[stack.index(resolved) :], resolved])
        raise ConfigError(named_by, "extends", circle, "files that do not extend each other in a circle")
    data = _load(path, named_by, stack)
    extends = data.pop("extends", [])
    parents = [extends] if isinstance(extends, str) else extends
    if not isinstance(parents, list) or not all(isinstance(parent, str) and parent for parent in parents):
        raise ConfigError(str(path), "extends", extends, "a file name or a list of file names, relative to this file")
    for parent in parents:
        _read_into(raw, path.parent / parent, [*stack, resolved], str(path))
    _merge(raw, raw.data, data, (), str(path))


def _merge(raw: RawConfig, target: dict[str, Any], new: dict[str, Any], prefix: Key, source: str) -> None:
    for name, value in new.items():
        key = (*prefix, name)
        raw.sources[key] = source
        # A table with another `kind` is another thing: its old keys would only be errors.
        other_kind = (
            isinstance(value, dict) and "kind" in value and name in target and value["kind"] != _kind(target[name])
        )
        if isinstance(value, dict) and isinstance(target.get(name), dict) and not other_kind:
            _merge(raw, target[name], value, key, source)
        else:
            _forget(raw, key)
            raw.sources[key] = source
            target[name] = {} if isinstance(value, dict) else copy.deepcopy(value)
            if isinstance(value, dict):
                _merge(raw, target[name], value, key, source)


def _kind(table: Any) -> Any:
    return table.get("kind") if isinstance(table, dict) else None


def _forget(raw: RawConfig, key: Key) -> None:
    for known in [k for k in raw.sources if k[: len(key)] == key]:
        del raw.sources[known]


def parse_override(text: str) -> tuple[list[str], Any]:
    """`a.b=c` as key parts and value; the value is read as TOML and, where it is not TOML, taken as a string.

    Raises:
        ConfigError: no `=`, or a key that is not a dotted TOML key.
    """
    name, equals, value_text = text.partition("=")
    allowed = "key=value with a dotted key, such as --set fiber.eta=1.6"
    if not equals or not name.strip():
        raise ConfigError(COMMAND_LINE, "(key)", text, allowed)
    try:
        table = tomllib.loads(f"{name} = 0")
    except (tomllib.TOMLDecodeError, RecursionError):
        raise ConfigError(COMMAND_LINE, "(key)", name, allowed) from None
    parts: list[str] = []
    while isinstance(table, dict):
        if len(table) != 1:
            raise ConfigError(COMMAND_LINE, "(key)", name, allowed)
        ((part, table),) = table.items()
        parts.append(part)
    return parts, parse_value(value_text)


def parse_value(text: str) -> Any:
    """A TOML value, or the text itself where it is none."""
    try:
        table = tomllib.loads(f"value = {text}")
    except (tomllib.TOMLDecodeError, RecursionError, ValueError):
        return text.strip()
    return table["value"] if set(table) == {"value"} else text.strip()


def apply_override(raw: RawConfig, text: str) -> None:
    """Apply one `--set key=value`; list elements are addressed by their index."""
    parts, value = parse_override(text)
    set_value(raw, parts, value, COMMAND_LINE)


def set_value(raw: RawConfig, parts: Sequence[str], value: Any, source: str) -> None:
    """Write `value` at the dotted key `parts`, making tables on the way.

    Raises:
        ConfigError: the key runs through something that is neither a table nor a list, or an index is out of range.
    """
    target: Any = raw.data
    key: list[str | int] = []
    for position, part in enumerate(parts):
        last = position == len(parts) - 1
        if isinstance(target, list):
            index = int(part) if part.isdecimal() and part.isascii() and len(part) < 9 else -1
            if not 0 <= index < len(target):
                where = (
                    f"an index from 0 to {len(target) - 1} into {dotted(key)}" if target else f"{dotted(key)} is empty"
                )
                raise ConfigError(source, dotted([*key, part]), part, where)
            key.append(index)
            if last:
                target[index] = value
            else:
                target = target[index]
        elif isinstance(target, dict):
            key.append(part)
            if last and isinstance(value, dict):
                _merge(raw, target, {part: value}, tuple(key[:-1]), source)
                return
            elif last:
                target[part] = value
            else:
                target = target.setdefault(part, {})
        else:
            raise ConfigError(
                source, dotted([*key, *parts[position:]]), target, f"{dotted(key)} is a value, not a table"
            )
    _forget(raw, tuple(key))
    raw.sources[tuple(key)] = source
