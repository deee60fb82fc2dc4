"""Pictures inside a page: as they are while they are small, else without loss in a denser format, else reduced."""

from __future__ import annotations

import base64
import io
import warnings
from pathlib import Path
from typing import TYPE_CHECKING

from dsfit.report.links import Place, size
from dsfit.report.page import Picture

if TYPE_CHECKING:
    from PIL.Image import Image

BUDGET = 10_500_000
"""Bytes of all pictures of a page together; as base64 they take a third more."""
MOST, LEAST = 900_000, 30_000
"""Bytes of one picture: no more than this even where it is the only one, and what it may always have."""
_ENLARGED, _SCREEN = 1.2, 96.0
_MOST_PIXELS = 80_000_000
_WIDTHS = (2400, 1800, 1400, 1000, 700, 500)
_LONGEST = 16_000  # WebP ends at 16383 pixels
_QUALITIES = (88, 70)
_FORMATS = {".pdf": "PDF", ".pgf": "PGF", ".exr": "EXR", ".tex": "TeX"}


class Album:
    """Embeds the pictures of one page; `count` of them share its budget."""

    def __init__(self, place: Place, count: int) -> None:
        self._place = place
        self._limit = min(max(BUDGET // max(count, 1), LEAST), MOST)

    def picture(self, path: Path, caption: str, name: str = "", alt: str = "") -> Picture:
        """The picture in the file, or a note in its place; `alt` is told to those who do not see it, instead of the
        caption."""
        name = name or path.stem
        beside = [path.with_suffix(suffix) for suffix in _FORMATS]
        others = [self._place.link(p, _FORMATS[p.suffix]) for p in beside if p.is_file()]
        full = self._place.link(path) if path.is_file() else None
        try:
            source, width, height, note = embed(path, self._limit)
        except OSError as error:
            source, width, height = "", 0, 0
            note = f"{path.name}: {error.strerror or error}"
        return Picture(name, caption, _alt(name, alt or caption), source, width, height, full, others, note)


def _alt(name: str, caption: str) -> str:
    sentence = caption.split(". ")[0].rstrip(".")
    return f"{name}: {sentence}." if sentence else name


def embed(path: Path, limit: int) -> tuple[str, int, int, str]:
    """Data URI, width and height to show it at, and how it differs from the file (empty: the same pixels).

    Figures tell their resolution: they are shown a fifth larger than in print, whatever their pixels.

    Raises:
        OSError: there is no such picture, it is damaged, or too large to open.
    """
    from PIL import Image as images

    content = path.read_bytes()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # about its size, which is looked at here
            with images.open(io.BytesIO(content), formats=("PNG",)) as image:
                if image.width * image.height > _MOST_PIXELS:
                    raise OSError(f"too large for a page: {image.width} x {image.height} pixels")
                image.load()
                width, height = _shown(image)
                if len(content) <= limit:
                    return _uri("png", content), width, height, ""
                source, note = _smaller(_on_white(image), limit, len(content))
                return source, width, height, note
    except OSError:
        raise
    except Exception as error:  # damaged files make zlib, struct and Pillow complain each in its own way
        raise OSError(f"damaged picture ({type(error).__name__}: {error})"[:200]) from None


def _shown(image: Image) -> tuple[int, int]:
    """Width and height in CSS pixels, 96 to an inch."""
    density = image.info.get("dpi", (0, 0))[0]
    scale = _ENLARGED * _SCREEN / density if 50 <= density <= 1200 else 1.0
    return max(1, round(image.width * scale)), max(1, round(image.height * scale))


def _on_white(image: Image) -> Image:
    from PIL import Image as images

    if "A" not in image.getbands() and "transparency" not in image.info:
        return image.convert("RGB")
    clear = image.convert("RGBA")
    paper = images.new("RGBA", clear.size, "white")
    paper.alpha_composite(clear)
    return paper.convert("RGB")


def _smaller(image: Image, limit: int, before: int) -> tuple[str, str]:
    """WebP without loss if that is small enough, else with loss, and at last narrower."""
    packed = b""
    if max(image.size) <= _LONGEST:
        packed = _webp(image, None)
        if len(packed) <= limit:
            return _uri("webp", packed), ""
    for width in (image.width, *(w for w in _WIDTHS if w < image.width)):
        height = max(1, round(image.height * width / image.width))
        if max(width, height) > _LONGEST:
            continue
        narrow = image if width == image.width else image.resize((width, height))
        for quality in _QUALITIES:
            packed = _webp(narrow, quality)
            if len(packed) <= limit:
                return _uri("webp", packed), _note(before)
    if not packed:
        raise OSError(f"too long for a page: {image.width} x {image.height} pixels")
    return _uri("webp", packed), _note(before)


def _note(before: int) -> str:
    return f"compressed for this page; the file has {size(before)}"


def _webp(image: Image, quality: int | None) -> bytes:
    """Without loss if no quality is given."""
    buffer = io.BytesIO()
    options = {"lossless": True, "quality": 50, "method": 3} if quality is None else {"quality": quality, "method": 4}
    image.save(buffer, "WEBP", **options)
    return buffer.getvalue()


def _uri(kind: str, content: bytes) -> str:
    return f"data:image/{kind};base64,{base64.b64encode(content).decode()}"
