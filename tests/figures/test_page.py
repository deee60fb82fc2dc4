"""Figures of other widths come to the page's width: type, lines, marks and gaps with them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure
from matplotlib.text import Text

from dsfit.experiment.plots.style import new_figure, styled
from dsfit.figures.page import Page


def figure_of(width: float, height: float) -> Figure:
    """Lines, marks, bars, areas, a picture with its scale, notes and legends."""
    figure = new_figure(width, height)
    axes = figure.subplots(1, 2)
    x = np.linspace(0.1, 10, 20)
    left, right = axes
    left.plot(x, np.exp(x), "o-", linewidth=2, markersize=6, label="line")
    left.scatter(x, 5 * x, s=36, label="dots")
    left.fill_between(x, x, 2 * x, label="band")
    left.errorbar(x, x, yerr=0.5 * x, capsize=3, label="bars")
    left.set(yscale="log", title="title", xlabel="x")
    left.annotate("note", (5, 100), (20, 10), textcoords="offset points", arrowprops={"arrowstyle": "->"})
    left.text(0.5, 0.5, "small", fontsize=4)
    left.legend(title="legend")
    figure.colorbar(right.imshow(x.reshape(4, 5)), ax=right, label="value")
    figure.legend(loc="outside lower center", ncols=4)
    figure.suptitle("all", fontsize=12)
    return figure


def sizes(figure: Figure) -> dict[str, float]:
    """Type by words, once drawn."""
    figure.draw_without_rendering()
    return {text.get_text(): text.get_fontsize() for text in figure.findobj(Text) if text.get_text()}


def test_width_proportions_and_type():
    with styled():
        figure = Page(150.0).adopt(figure_of(8.0, 4.0))
        found = sizes(figure)
    width, height = figure.get_size_inches()
    assert width == pytest.approx(150 / 25.4) and height == pytest.approx(width / 2)
    factor = width / 8
    assert found["all"] == pytest.approx(12 * factor) and found["title"] == pytest.approx(9 * factor)
    assert found["small"] == 4  # was below the least, and does not grow
    assert min(size for words, size in found.items() if words != "small") == pytest.approx(8 * factor)


def test_no_type_below_the_least_that_can_be_read():
    with styled():
        found = sizes(Page(150.0).adopt(figure_of(20.0, 10.0)))
    assert min(size for words, size in found.items() if words != "small") == 5.5
    assert found["$\\mathdefault{10^{2}}$"] == 5.5  # a tick's, made when it is drawn


def test_lines_marks_and_handles_shrink():
    with styled():
        figure, page = figure_of(10.0, 5.0), Page(127.0)  # half as wide
        page.adopt(figure)
        figure.draw_without_rendering()
    axes = figure.axes[0]
    line = axes.lines[0]
    assert line.get_linewidth() == 1 and line.get_markersize() == 3
    assert axes.collections[0].get_sizes() == pytest.approx([9])
    assert axes.texts[0].xyann == (10, 5)
    tick = axes.xaxis.get_major_ticks()[0]
    assert tick.tick1line.get_markersize() == pytest.approx(3.5 / 2)
    for legend in (axes.get_legend(), figure.legends[0]):
        box = legend.get_window_extent()
        for handle in legend.legend_handles:
            extent = handle.get_window_extent()
            assert box.x0 <= extent.x0 and extent.x1 <= box.x1 and box.y0 <= extent.y0 and extent.y1 <= box.y1


def handle_widths(figure: Figure) -> np.ndarray:
    """Of areas in the legends, in points."""
    figure.draw_without_rendering()
    legends = [figure.axes[0].get_legend(), *figure.legends]
    handles = [legend.legend_handles[2] for legend in legends]
    return np.array([handle.get_window_extent().width for handle in handles]) * 72 / figure.dpi


def test_handles_of_legends_keep_to_their_type():
    with styled():
        before = handle_widths(figure_of(10.0, 5.0))
        after = handle_widths(Page(127.0).adopt(figure_of(10.0, 5.0)))
    assert after / before == pytest.approx(5.5 / 8, rel=0.05)  # type stopped there, below it half


def test_nothing_leaves_the_page(tmp_path: Path):
    with styled():
        figure = Page(150.0).adopt(figure_of(14.0, 7.0))
        figure.draw_without_rendering()
    assert figure.get_tightbbox().x0 >= -0.01 and figure.get_tightbbox().x1 <= 150 / 25.4 + 0.01


def test_a_narrow_figure_grows_with_its_type_as_it_was():
    with styled():
        figure = Page(150.0).adopt(figure_of(3.0, 3.0))
        assert sizes(figure)["title"] == 9
    assert figure.get_size_inches()[0] == pytest.approx(150 / 25.4)


def test_files_are_as_wide_as_the_page(tmp_path: Path):
    with styled():
        written = Page(100.0).save(Page(100.0).adopt(figure_of(8.0, 4.0)), tmp_path, "figure")
    assert [path.name for path in written] == ["figure.png", "figure.pdf"]
    assert b"/MediaBox [ 0 0 283." in written[1].read_bytes()
