"""What all figures share: colours that colour-blind readers can tell apart, sizes, and saving as PNG and PDF."""

from __future__ import annotations

import contextlib
import io
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import matplotlib
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.text import Text

from dsfit.experiment.about import KEY, About, to_text
from dsfit.experiment.about import about as make_about
from dsfit.experiment.files import write_bytes

# Okabe and Ito's palette with grey for its yellow, which is too light for lines on white.
COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00", "#000000", "#8C8C8C")
MARKERS = ("o", "s", "^", "D", "v", "P", "X", "<", ">", "*")

_RC: dict[str, Any] = {
    "font.size": 9,
    "axes.titlesize": 9,
    "axes.labelsize": 9,
    "legend.fontsize": 8,
    "xtick.labelsize": 8,
    "ytick.labelsize": 8,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "grid.color": "#dddddd",
    "grid.linewidth": 0.6,
    "axes.axisbelow": True,
    "savefig.dpi": 150,
    "pdf.fonttype": 42,
}


@contextlib.contextmanager
def styled() -> Iterator[None]:
    """Figures made inside use dsfit's settings; the caller's matplotlib is left as it was."""
    with matplotlib.rc_context(_RC):
        yield


def new_figure(width: float, height: float) -> Figure:
    """An empty figure (inches) on the Agg canvas, which needs no display."""
    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def look(index: int) -> dict[str, Any]:
    """Colour and marker of the method at this index; colours repeat only with another marker."""
    return {"color": COLORS[index % len(COLORS)], "marker": MARKERS[index % len(MARKERS)]}


def save(
    figure: Figure, folder: Path, name: str, about: About | None = None, kinds: Sequence[str] = ("png", "pdf")
) -> list[Path]:
    """Write `name.png` and `name.pdf` atomically; returns the paths.

    Args:
        figure: what to write.
        folder: where.
        name: file name without suffix.
        about: where it comes from, from `dsfit.experiment.about`; left out, the present code and packages.
        kinds: suffixes of the files.
    """
    _plain(figure)
    figure.draw_without_rendering()
    figure.set_layout_engine("none")  # laid out once, not once more for every format
    return [write_figure(figure, folder / f"{name}.{kind}", about) for kind in kinds]


def write_figure(figure: Figure, path: Path, about: About | None = None) -> Path:
    """Write the figure atomically in the format that the name ends with, and in it where it comes from."""
    about = make_about(path.stem) if about is None else about
    kind, buffer = path.suffix.removeprefix("."), io.BytesIO()
    figure.savefig(buffer, format=kind, metadata=_metadata(kind, path.stem, about))
    write_bytes(path, buffer.getvalue())
    return path


def _metadata(kind: str, name: str, about: About) -> dict[str, Any]:
    """Under the names that the format has; a PDF's date is left out, so that bytes repeat."""
    maker = f"dsfit {about['dsfit']}"
    if kind == "png":
        return {"Title": f"{about['name']}: {name}", "Software": maker, KEY: to_text(about)}
    title = f"{about['name']}: {name}"
    return {"Title": title, "Creator": maker, "Keywords": to_text(about), "CreationDate": None}


def _plain(figure: Figure) -> None:
    """Titles and labels as they are: two dollars in a method's name do not start a formula (those of ticks do)."""
    ticks = {
        id(label)
        for axes in figure.axes
        for axis in (axes.xaxis, axes.yaxis)
        for label in axis.get_ticklabels(which="both")
    }
    for text in figure.findobj(Text):
        if id(text) not in ticks:
            text.set_parse_math(False)


def spread(count: int, most: int) -> list[int]:
    """At most `most` indices out of `count`, evenly spread, first and last among them."""
    if count <= most:
        return list(range(count))
    return sorted({round(i * (count - 1) / max(most - 1, 1)) for i in range(most)})


def short(label: str, width: int = 28) -> str:
    """A label that fits: cut in the middle of long names."""
    return label if len(label) <= width else label[: width // 2] + "…" + label[-(width // 2 - 1) :]
