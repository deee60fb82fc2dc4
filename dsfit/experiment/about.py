"""Where a picture comes from, written into its file and read back: name, hashes of settings and data, code, packages.

Nothing of it is a clock: the same data, drawn by the same code, give the same bytes. PNG keeps it as the text `dsfit`,
PDF as the keywords of its information, PGF as a comment, EXR as attributes `dsfit.*` (renderings tell their seconds
there as well).
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Iterable, Mapping
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from dsfit.errors import InputError
from dsfit.experiment import provenance
from dsfit.experiment.rundir import RunDirectory

KEY = "dsfit"
PGF_MARK = "%% dsfit: "
_PACKAGES = ("torch", "numpy", "matplotlib")

About = Mapping[str, Any]


def about(name: str, record: Mapping[str, Any] | None = None, **more: Any) -> dict[str, Any]:
    """What a file says about itself.

    Args:
        name: of the experiment or the run.
        record: `provenance` of the data; left out, that of this process.
        more: hashes and whatever else, as plain values.
    """
    record = _present() if record is None else record
    packages = record.get("packages", {})
    return {
        "name": name,
        "dsfit": record.get("dsfit"),
        "git": commit(record),
        "packages": {name: packages[name] for name in _PACKAGES if packages.get(name)},
        **more,
    }


def about_run(directory: RunDirectory, result: Mapping[str, Any]) -> dict[str, Any]:
    """Of a figure of a run: `data` is the hash of the cells' numbers and arrays."""
    content = [json.dumps(result["cells"], sort_keys=True).encode()]
    content += [path.read_bytes() for path in sorted((directory.path / "cells").glob("*.npz"))]
    settings = plain_hash(result["config"])
    record = result.get("provenance")
    return about(result["name"], record, run=result.get("run_id"), settings=settings, data=digest(content))


def commit(record: Mapping[str, Any]) -> str:
    """The commit that code was at."""
    git = record.get("git")
    return "unknown" if git is None else git["commit"] + (" with changes" if git["changed"] else "")


def digest(parts: Iterable[bytes]) -> str:
    """Hash of contents, sixteen digits of SHA-256."""
    whole = hashlib.sha256()
    for part in parts:
        whole.update(hashlib.sha256(part).digest())
    return whole.hexdigest()[:16]


def plain_hash(data: Any) -> str:
    """Hash of plain values, whatever the order of keys."""
    return digest([json.dumps(data, sort_keys=True).encode()])


def array_hash(values: np.ndarray) -> str:
    """Hash of an array's values as float32."""
    return digest([np.ascontiguousarray(values, dtype=np.float32).tobytes()])


def exr_attributes(found: About) -> dict[str, str]:
    """The attributes of an EXR file; `dsfit` is called `dsfit.version` there."""
    return {
        f"{KEY}.{'version' if name == KEY else name}": value if isinstance(value, str) else to_text(value)
        for name, value in found.items()
    }


def from_exr(attributes: Mapping[str, Any]) -> dict[str, Any]:
    """What the attributes of an EXR file tell, the inverse of `exr_attributes`."""
    found = {k.removeprefix(f"{KEY}."): _plain(v) for k, v in attributes.items() if k.startswith(f"{KEY}.")}
    return {(KEY if name == "version" else name): value for name, value in found.items()}


def to_text(found: About) -> str:
    """One line of ASCII."""
    return json.dumps(found, sort_keys=True)


def read_about(path: str | Path) -> dict[str, Any]:
    """What a PNG, PDF, PGF or EXR file that dsfit wrote says about itself.

    Raises:
        InputError: the file is missing, of another kind, or says nothing.
    """
    path = Path(path)
    readers = {".png": _from_png, ".pdf": _from_pdf, ".pgf": _from_pgf, ".exr": _from_exr}
    if path.suffix.lower() not in readers:
        raise InputError(str(path), path.suffix, "a file that ends with " + ", ".join(readers))
    try:
        text = readers[path.suffix.lower()](path)
        found = json.loads(text) if text else None
    except InputError:
        raise
    except (OSError, ValueError, SyntaxError) as error:
        raise InputError(str(path), str(error)[:100], "a whole picture that dsfit wrote") from None
    if not isinstance(found, dict):
        raise InputError(str(path), "it says nothing of where it comes from", "a picture that dsfit wrote")
    return found


def _from_png(path: Path) -> str | None:
    from PIL import Image

    with Image.open(path) as image:
        return getattr(image, "text", {}).get(KEY)


def _from_pdf(path: Path) -> str | None:
    """The keywords of the information dictionary, which matplotlib writes as it stands, uncompressed."""
    content = path.read_bytes()
    if not content.startswith(b"%PDF"):
        raise ValueError("not a PDF file")
    found = re.search(rb"/Keywords \(((?:[^\\()]|\\.)*)\)", content, re.DOTALL)
    if found is None:
        return None
    replaced = re.sub(rb"\\(.)", lambda m: {b"n": b"\n", b"r": b"\r"}.get(m[1], m[1]), found[1], flags=re.DOTALL)
    return replaced.decode("ascii")


def _from_pgf(path: Path) -> str | None:
    for line in path.read_text(encoding="utf-8").splitlines()[:5]:
        if line.startswith(PGF_MARK):
            return line.removeprefix(PGF_MARK)
    return None


def _from_exr(path: Path) -> str | None:
    from dsfit.scene.exr import read_exr

    found = from_exr(read_exr(path).metadata)
    return json.dumps(found) if found else None


def _plain(value: Any) -> Any:
    if isinstance(value, str) and value.startswith("{"):
        try:
            return json.loads(value)
        except ValueError:
            return value
    return value


@cache
def _present() -> dict[str, Any]:
    return provenance.provenance()
