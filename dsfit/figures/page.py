"""The page that figures are made for: widths in the text block of a thesis, sizes of type, and saving."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from matplotlib.figure import Figure

from dsfit.experiment.about import About
from dsfit.experiment.about import about as make_about
from dsfit.experiment.plots.style import new_figure, save
from dsfit.figures.adopt import adopt

MILLIMETRE = 1 / 25.4


@dataclass(frozen=True)
class Page:
    """The text block.

    Attributes:
        width_mm: its width; figures are as wide.
    """

    width_mm: float = 150.0

    @property
    def width(self) -> float:
        """Width in inches, matplotlib's unit."""
        return self.width_mm * MILLIMETRE

    def figure(self, height: float) -> Figure:
        """An empty figure as wide as the text; `height` in units of its width."""
        return new_figure(self.width, self.width * height)

    def adopt(self, figure: Figure) -> Figure:
        """A figure made for another width, brought to this one with its type (not below 5.5 pt), lines and marks."""
        adopt(figure, self.width)
        return figure

    def save(
        self, figure: Figure, folder: Path, name: str, about: About | None = None, *, pgf: bool = False
    ) -> list[Path]:
        """Write it as PNG and PDF, at wish as PGF too; returns the paths.

        Raises:
            InputError: PGF is asked for, and there is no TeX system.
        """
        written = save(figure, folder, name, about)
        if pgf:
            from dsfit.figures.pgf import write_pgf

            written += write_pgf(figure, folder, name, about or make_about(name))
        return written
