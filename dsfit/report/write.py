"""Finds out what a folder holds, makes its page and writes it."""

from __future__ import annotations

import base64
import hashlib
import re
from functools import cache
from pathlib import Path
from typing import Any

from dsfit.errors import InputError
from dsfit.experiment import files
from dsfit.report.links import Place
from dsfit.report.page import Page

NAME = "report.html"
_TEMPLATES = Path(__file__).parent / "templates"
# control characters, which HTML forbids; lone surrogates, which UTF-8 does; marks that turn the order of letters
_FORBIDDEN = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u202a-\u202e\u2066-\u2069\ud800-\udfff\ufffe\uffff]")
_ESCAPES = re.compile(r"\x1b\[[0-9;?]*[A-Za-z]")


def write_report(folder: str | Path, out: str | Path | None = None, root: str | Path = ".") -> Path:
    """Write the page of a run directory, of the output directory of `dsfit figures`, or of a sweep; returns its path.

    The page is one file that needs nothing else; its links lead to the files beside it. The same files give the same
    bytes.

    Args:
        folder: what it is about.
        out: the file; left out, `report.html` in the folder.
        root: the folder that holds `experiments` and `configs`, for what `dsfit figures` knows of its experiments.

    Raises:
        InputError: the folder is none of these.
        OSError: the page cannot be written.
    """
    folder = Path(folder)
    path = folder / NAME if out is None else Path(out)
    page = make_page(folder, Place(path), Path(root))
    if path.is_dir():
        raise InputError("--out", str(path), "a file")
    files.write_bytes(path, render(page).encode())
    return path


def make_page(folder: Path, place: Place, root: Path) -> Page:
    """The page of whatever the folder holds.

    Raises:
        InputError: it holds nothing that dsfit wrote.
    """
    allowed = "a run directory, or the output directory of `dsfit figures` or `dsfit sweep`"
    try:
        there = {path.name for path in folder.iterdir()}
    except (OSError, ValueError) as error:
        raise InputError(str(folder), getattr(error, "strerror", None) or str(error), allowed) from None
    if "manifest.json" in there or any(any(folder.glob(f"*/{n}.json")) for n in ("computed", "failed")):
        from dsfit.report.figures import figures_page

        return figures_page(folder, place, root)
    if there & {"sweep.json", "cells.log"}:
        from dsfit.report.sweep import sweep_page

        return sweep_page(folder, place)
    if there & {"config.toml", "result.json"}:
        from dsfit.report.run import run_page

        return run_page(folder, place)
    raise InputError(str(folder), "neither", allowed)


def clean(value: Any) -> Any:
    """Text without what HTML and UTF-8 cannot hold; markup made by the templates stays as it is."""
    from markupsafe import Markup

    if isinstance(value, Markup):
        return value
    return _FORBIDDEN.sub("\ufffd", _ESCAPES.sub("", str(value)).replace("\r", ""))


def prose(text: Any) -> Any:
    """Escaped text with what stands between backticks as code."""
    from markupsafe import Markup, escape

    parts = str(clean(text)).split("`")
    if len(parts) % 2 == 0:
        return escape("`".join(parts))
    return Markup("").join(
        Markup("<code>{}</code>").format(part) if k % 2 else escape(part) for k, part in enumerate(parts)
    )


def _hash(text: str) -> str:
    return "sha256-" + base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()


@cache
def _environment() -> Any:
    """The templates, which escape everything and know no undefined names; style and script by hash, all else refused
    by the browser."""
    import jinja2
    from markupsafe import Markup

    found = jinja2.Environment(
        loader=jinja2.FileSystemLoader(_TEMPLATES),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        finalize=clean,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    style, script = ((_TEMPLATES / name).read_text(encoding="utf-8") for name in ("page.css", "page.js"))
    policy = (
        f"default-src 'none'; img-src data:; style-src '{_hash(style)}'; script-src '{_hash(script)}'; "
        "base-uri 'none'; form-action 'none'"
    )
    found.filters["prose"] = prose
    found.globals.update(style=Markup(style), script=Markup(script), policy=policy)
    return found


def render(page: Page) -> str:
    """The page as HTML."""
    return _environment().get_template("page.html").render(page=page)
