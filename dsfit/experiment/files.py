"""Files that are either whole or not there: atomic writes, and readers that turn any damage into one `InputError`."""

from __future__ import annotations

import io
import json
import math
import os
import re
from pathlib import Path
from typing import Any

import numpy as np

from dsfit.errors import InputError

_BARE_KEY = re.compile(r"[A-Za-z0-9_-]+")


def write_bytes(path: str | Path, content: bytes) -> None:
    """Write through a temporary file in the same folder and `os.replace`: readers see the old file or the new one,
    never a part."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        with open(temporary, "wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise


def write_json(path: str | Path, data: Any) -> None:
    """Write JSON with sorted keys; nan and inf, which JSON lacks, become the strings "nan", "inf", "-inf"."""
    write_bytes(path, json_bytes(data))


def json_bytes(data: Any) -> bytes:
    """What `write_json` writes."""
    return (json.dumps(_plain(data), indent=1, sort_keys=True, allow_nan=False) + "\n").encode()


def _plain(data: Any) -> Any:
    if isinstance(data, dict):
        return {str(key): _plain(value) for key, value in data.items()}
    if isinstance(data, list | tuple):
        return [_plain(value) for value in data]
    if isinstance(data, np.generic):
        return _plain(data.item())
    if isinstance(data, float) and not math.isfinite(data):
        return str(data)
    return data


def number(value: Any) -> float:
    """A number written by `write_json` (None reads as nan)."""
    return math.nan if value is None else float(value)


def read_json(path: str | Path, schema_version: int) -> dict[str, Any]:
    """Read a JSON object that carries this `schema_version`.

    Raises:
        InputError: the file is missing, damaged, or of another schema version.
    """
    allowed = f"a file written by dsfit with schema version {schema_version}"
    try:
        data = json.loads(Path(path).read_bytes().decode("utf-8"))
    except OSError as error:
        raise InputError(str(path), error.strerror, allowed) from None
    except (ValueError, RecursionError) as error:
        raise InputError(str(path), f"damaged: {error}"[:100], allowed) from None
    found = data.get("schema_version") if isinstance(data, dict) else None
    if found != schema_version or isinstance(found, bool):
        raise InputError(str(path), f"schema version {found}", allowed)
    return data


def write_arrays(path: str | Path, arrays: dict[str, np.ndarray]) -> None:
    """Write named arrays as a compressed npz."""
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **arrays)
    write_bytes(path, buffer.getvalue())


def read_arrays(path: str | Path) -> dict[str, np.ndarray]:
    """Read an npz written by `write_arrays`.

    Raises:
        InputError: the file is missing or damaged.
    """
    try:
        with np.load(io.BytesIO(Path(path).read_bytes()), allow_pickle=False) as archive:
            return {name: archive[name] for name in archive.files}
    except OSError as error:
        raise InputError(str(path), error.strerror or str(error), "a readable npz file") from None
    except Exception as error:  # zipfile, zlib, numpy and struct each have their own way to complain about damage
        raise InputError(
            str(path), f"damaged: {type(error).__name__}: {error}"[:100], "an npz file written by dsfit"
        ) from None


def to_toml(data: dict[str, Any]) -> str:
    """A TOML document for nested tables of strings, booleans, numbers and lists; None is left out."""
    lines: list[str] = []
    _toml_table(data, (), lines)
    return "\n".join(lines).lstrip("\n") + "\n"


def _toml_table(table: dict[str, Any], path: tuple[str, ...], lines: list[str]) -> None:
    later = []
    for key, value in table.items():
        if isinstance(value, dict) or (isinstance(value, list) and value and all(isinstance(x, dict) for x in value)):
            later.append((key, value))
        elif value is not None:
            lines.append(f"{_toml_key(key)} = {_toml_value(value)}")
    for key, value in later:
        name = ".".join(_toml_key(part) for part in (*path, key))
        for item in value if isinstance(value, list) else [value]:
            lines += ["", f"[[{name}]]" if isinstance(value, list) else f"[{name}]"]
            _toml_table(item, (*path, key), lines)


def _toml_key(key: str) -> str:
    return key if _BARE_KEY.fullmatch(key) else _toml_string(key)


def _toml_string(text: str) -> str:
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")


def _toml_value(value: Any) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        return _toml_string(value)
    if isinstance(value, int):
        return str(value)
    if isinstance(value, float):
        return repr(value)
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{_toml_key(k)} = {_toml_value(v)}" for k, v in value.items() if v is not None) + " }"
    return "[" + ", ".join(_toml_value(item) for item in value) + "]"
