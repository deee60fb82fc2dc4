"""Brings a figure that was made for another width to the width of a page: sizes in points are scaled with it.

matplotlib keeps type, lines, marks and gaps in points, whatever the size of the figure; a figure that is only made
smaller has type too large for it. What is kept in units of axes, figure or type follows by itself.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.collections import Collection
from matplotlib.figure import Figure
from matplotlib.legend import Legend
from matplotlib.lines import Line2D
from matplotlib.offsetbox import DrawingArea, PackerBase
from matplotlib.patches import FancyArrowPatch, Patch
from matplotlib.spines import Spine
from matplotlib.text import Annotation, Text
from matplotlib.transforms import Affine2D

LEAST_TYPE = 5.5
_SIDES = ("left", "right", "bottom", "top")


def adopt(figure: Figure, width: float) -> None:
    """Give the figure this width (inches), with its proportions.

    Type, line widths, marks and gaps shrink by the same factor, type not below 5.5 pt. A figure that was narrower grows
    with its type as it was.

    Offsets in points that stand inside a transform (`offset_copy`) stay.
    """
    old_width, old_height = figure.get_size_inches()
    figure.set_size_inches(width, old_height * width / old_width)
    factor = float(width / old_width)
    if factor >= 1:
        return
    engine = figure.get_layout_engine()
    if engine is not None and hasattr(engine, "get"):
        pads = {name: value * factor for name, value in engine.get().items() if name in ("w_pad", "h_pad")}
        engine.set(**pads)
    for artist, gaps in list(_artists(figure, factor, factor)):
        _scale(artist, factor, gaps)


def _artists(artist: Artist, s: float, gaps: float) -> Iterator[tuple[Artist, float]]:
    """All that is drawn, and the factor of its gaps: in legends that of their type, of which they are multiples.

    An axis stands for its ticks, since they are made anew when it is drawn.
    """
    if isinstance(artist, Legend) and artist.get_texts():
        size = artist.get_texts()[0].get_fontsize()
        gaps = _type(size, s) / size
    yield artist, gaps
    children = [artist.label, artist.offsetText] if isinstance(artist, Axis) else artist.get_children()
    for child in children:
        yield from _artists(child, s, gaps)


def _type(size: float, s: float) -> float:
    """A size of type made smaller, but neither below the least that can be read nor larger than it was."""
    return max(size * s, min(LEAST_TYPE, size))


def _scale(artist: Artist, s: float, gaps: float) -> None:
    if isinstance(artist, Text):
        artist.set_fontsize(_type(artist.get_fontsize(), s))
        if isinstance(artist, Annotation):
            _annotation(artist, s)
    elif isinstance(artist, Line2D):
        artist.set_linewidth(artist.get_linewidth() * s)
        artist.set_markersize(artist.get_markersize() * s)
        artist.set_markeredgewidth(artist.get_markeredgewidth() * s)
    elif isinstance(artist, Patch):
        if isinstance(artist, Spine) and artist.spine_type in _SIDES and artist.get_position()[0] == "outward":
            artist.set_position(("outward", artist.get_position()[1] * s))
        artist.set_linewidth(artist.get_linewidth() * s)
        if isinstance(artist, FancyArrowPatch):
            artist.set_mutation_scale(artist.get_mutation_scale() * s)
    elif isinstance(artist, Collection):
        artist.set_linewidth([w * s for w in artist.get_linewidth()])
        if hasattr(artist, "set_sizes") and artist.get_sizes() is not None:
            artist.set_sizes(artist.get_sizes() * s**2, artist.get_figure(root=True).dpi)
    elif isinstance(artist, Axes):
        _title(artist, s)
    elif isinstance(artist, Axis):
        _axis(artist, s)
    elif isinstance(artist, Legend):
        artist.borderaxespad *= gaps
    elif isinstance(artist, PackerBase):
        for name in ("pad", "sep", "width", "height"):
            if (value := getattr(artist, name)) is not None:
                setattr(artist, name, value * gaps)
    elif isinstance(artist, DrawingArea):
        _drawing_area(artist, gaps)


def _annotation(note: Annotation, s: float) -> None:
    """Places in points from elsewhere, and the arrow, which is not among the children."""
    for place, coords in (("xyann", note.anncoords), ("xy", note.xycoords)):
        both = coords if isinstance(coords, tuple) else (coords, coords)
        scales = [s if isinstance(kind, str) and kind.endswith("points") else 1.0 for kind in both]
        setattr(note, place, tuple(v * k if k != 1 else v for v, k in zip(getattr(note, place), scales, strict=True)))
    if (arrow := note.arrow_patch) is not None:
        _scale(arrow, s, s)
        arrow.shrinkA, arrow.shrinkB = arrow.shrinkA * s, arrow.shrinkB * s
    if (box := note.get_bbox_patch()) is not None:
        box.set_linewidth(box.get_linewidth() * s)


def _title(axes: Axes, s: float) -> None:
    """The gap below the title, known only from the transform that makes it."""
    pad = axes.titleOffsetTrans.transform((0, 0))[1] / axes.get_figure(root=True).dpi * 72
    axes._set_title_offset_trans(float(pad * s))


def _axis(axis: Axis, s: float) -> None:
    axis.labelpad *= s
    for which, ticks in (("major", axis.get_major_ticks()), ("minor", axis.get_minor_ticks())):
        sizes: dict[str, Any] = {k: v for k, v in _tick_sizes(axis, which, ticks).items() if v is not None}
        label = sizes.pop("labelsize")
        scaled = {name: value * s for name, value in sizes.items()}
        axis.set_tick_params(which=which, labelsize=_type(label, s), **scaled)


def _tick_sizes(axis: Axis, which: str, ticks: list[Any]) -> dict[str, float]:
    """Sizes of an axis' ticks in points; a tick is made where there is none, as the axis does itself."""
    tick = ticks[0] if ticks else axis._get_tick(major=which == "major")
    return {
        "labelsize": tick.label1.get_fontsize(),
        "length": tick.tick1line.get_markersize(),
        "width": tick.tick1line.get_markeredgewidth(),
        "pad": tick.get_pad(),
        "grid_linewidth": tick.gridline.get_linewidth(),
    }


def _drawing_area(area: DrawingArea, s: float) -> None:
    """A legend's handle: its coordinates are points."""
    for name in ("width", "height", "xdescent", "ydescent"):
        setattr(area, name, getattr(area, name) * s)
    smaller = Affine2D().scale(s)
    for child in area.get_children():
        if isinstance(child, Collection) and hasattr(child, "set_sizes"):
            child.set_offset_transform(smaller + child.get_offset_transform())
        else:
            own = child.get_data_transform() if isinstance(child, Patch) else child.get_transform()
            child.set_transform(smaller + own)
