"""Figures as PGF, which a thesis sets in its own type; a TeX system measures the words."""

from __future__ import annotations

import io
import re
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any
from unittest import mock

import matplotlib
from matplotlib.backends import backend_pgf
from matplotlib.collections import Collection, QuadMesh
from matplotlib.figure import Figure
from matplotlib.font_manager import FontProperties

from dsfit.errors import InputError
from dsfit.experiment.about import KEY, PGF_MARK, About, to_text
from dsfit.experiment.files import write_bytes
from dsfit.figures.latex import escape

_SYSTEMS = ("pdflatex", "xelatex", "lualatex")
_PREAMBLE = r"\usepackage[T1]{fontenc}\usepackage{lmodern}\usepackage{textcomp}"
_MOST_SHAPES = 2000


@cache
def tex_system() -> str:
    """The first TeX system of pdflatex, xelatex and lualatex that is installed.

    Raises:
        InputError: there is none.
    """
    for name in _SYSTEMS:
        if shutil.which(name):
            return name
    raise InputError("--pgf", "no TeX system found", "an installed " + " or ".join(_SYSTEMS) + ", with lmodern")


def write_pgf(figure: Figure, folder: Path, name: str, about: About) -> list[Path]:
    """Write `name.pgf` and the pictures in it, `name-img0.png` and so on; returns the paths.

    The figure must have been laid out. Meshes and clouds of more than 2000 shapes become pictures: TeX has no memory
    for them. The document needs `\\usepackage{pgf,graphicx}`, `\\def\\mathdefault#1{#1}`, and the folder in
    `\\graphicspath`.

    Raises:
        InputError: there is no TeX system.
    """
    system = tex_system()
    rc = {"pgf.texsystem": system, "pgf.rcfonts": False, "pgf.preamble": _PREAMBLE, "savefig.dpi": 300}
    crowded = [c for c in figure.findobj(Collection) if _is_crowded(c) and not c.get_rasterized()]
    written = []
    with tempfile.TemporaryDirectory() as scratch, matplotlib.rc_context(rc), _plain_text(), _rasterized(crowded):
        figure.savefig(Path(scratch) / f"{name}.pgf", format="pgf")
        for path in sorted(Path(scratch).iterdir()):
            content = _marked(path, about) if path.suffix == ".pgf" else _stamped(path, about)
            write_bytes(folder / path.name, content)
            written.append(folder / path.name)
    return written


def _is_crowded(artist: Collection) -> bool:
    if isinstance(artist, QuadMesh):
        return True
    return max(len(artist.get_paths()), len(artist.get_offsets())) > _MOST_SHAPES


@contextmanager
def _rasterized(artists: list[Collection]) -> Iterator[None]:
    for artist in artists:
        artist.set_rasterized(True)
    try:
        yield
    finally:
        for artist in artists:
            artist.set_rasterized(False)


@contextmanager
def _plain_text() -> Iterator[None]:
    with mock.patch.object(backend_pgf, "RendererPgf", _Renderer):
        yield


class _Renderer(backend_pgf.RendererPgf):
    """Text is plain text but for what stands between dollars, and set in the document's roman type."""

    def draw_text(self, gc: Any, x: float, y: float, s: str, prop: FontProperties, angle: float,
                  ismath: bool | str = False, mtext: Any = None) -> None:  # fmt: skip
        """As matplotlib's, of the escaped text."""
        super().draw_text(gc, x, y, _tex(s, bool(ismath)), _roman(prop), angle, ismath, mtext)

    def get_text_width_height_descent(self, s: str, prop: FontProperties, ismath: bool | str) -> Any:
        """As matplotlib's, of the escaped text."""
        return super().get_text_width_height_descent(_tex(s, bool(ismath)), _roman(prop), ismath)


def _roman(prop: FontProperties) -> FontProperties:
    if prop.get_family()[0] == "monospace":
        return prop
    found = prop.copy()
    found.set_family("serif")
    return found


def _tex(text: str, math: bool) -> str:
    if not math:
        return escape(text)
    parts = text.split("$")
    return "$".join(escape(part) if k % 2 == 0 else _formula(part) for k, part in enumerate(parts))


def _formula(text: str) -> str:
    return re.sub(r"[^\x00-\x7f]+", lambda found: escape(found[0]), text)


def _marked(path: Path, about: About) -> bytes:
    first, rest = path.read_bytes().split(b"\n", 1)
    return first + b"\n" + (PGF_MARK + to_text(about)).encode() + b"\n" + rest


def _stamped(path: Path, about: About) -> bytes:
    from PIL import Image
    from PIL.PngImagePlugin import PngInfo

    text = PngInfo()
    text.add_text(KEY, to_text(about))
    buffer = io.BytesIO()
    with Image.open(path) as image:
        image.save(buffer, "png", pnginfo=text)
    return buffer.getvalue()
