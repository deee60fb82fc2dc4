"""Pages in a real browser: what they load, how they fit, what can be read, folded, scrolled, enlarged and printed."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from dsfit.report import write_report
from tests.report.conftest import RunOf
from tests.report.test_run_page import EVIL

WIDTHS = (360, 768, 1440)
Opened = Callable[..., Any]
# contrast of every text with what is behind it, from computed styles (WCAG 2)
CONTRAST = """() => {
  const parse = (c) => (c.match(/[\\d.]+/g) || []).map(Number);
  const light = (c) => {
    const linear = (x) => (x <= 0.03928 ? x / 12.92 : ((x + 0.055) / 1.055) ** 2.4);
    const [r, g, b] = c.slice(0, 3).map((x) => linear(x / 255));
    return 0.2126 * r + 0.7152 * g + 0.0722 * b;
  };
  const behind = (e) => {
    for (; e; e = e.parentElement) {
      const c = parse(getComputedStyle(e).backgroundColor);
      if (c.length === 3 || c[3] === 1) return c;
    }
    return [255, 255, 255];
  };
  const found = [];
  const walker = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT);
  for (let node; (node = walker.nextNode());) {
    const e = node.parentElement;
    if (!node.textContent.trim() || !e.checkVisibility() || ["SCRIPT", "STYLE"].includes(e.tagName)) continue;
    const pair = [light(parse(getComputedStyle(e).color)), light(behind(e))].sort((a, b) => b - a);
    const ratio = (pair[0] + 0.05) / (pair[1] + 0.05);
    if (ratio < 4.5) found.push([node.textContent.trim().slice(0, 40), e.tagName, ratio]);
  }
  return found;
}"""


@pytest.fixture(scope="session")
def pages(run_of: RunOf, experiments: tuple[Path, Path], tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """A run's page, that of all experiments, and one with markup everywhere and long names."""
    folder = Path(shutil.copytree(run_of("compare"), tmp_path_factory.mktemp("evil") / "run"))
    data = json.loads((folder / "result.json").read_text())
    data["title"], data["name"] = EVIL, "x" * 300
    for cell in data["cells"]:
        cell["label"] = "y" * 200
        cell["methods"][0]["name"], cell["methods"][1]["name"] = EVIL, "z" * 200
    data["cells"] *= 300
    (folder / "result.json").write_text(json.dumps(data))
    (folder / "figures" / "excess.png").unlink()
    return {
        "run": run_of("compare") / "report.html",
        "experiments": experiments[0] / "report.html",
        "evil": write_report(folder),
    }


@pytest.fixture
def opened(browser: Any, pages: dict[str, Path]) -> Iterator[Opened]:
    """Opens a page at a width; at the end nothing may have been requested but the page, nor any error told."""
    contexts, requested, told = [], [], []

    def open_(name: str, width: int = 1440, **options: Any) -> Any:
        contexts.append(browser.new_context(viewport={"width": width, "height": 800}, **options))
        page = contexts[-1].new_page()
        page.on("request", lambda request: requested.append((pages[name].as_uri(), request.url)))
        page.on("console", lambda message: told.append(message.text))
        page.on("pageerror", lambda error: told.append(str(error)))
        page.on("dialog", lambda dialog: (told.append(dialog.message), dialog.dismiss()))
        page.goto(pages[name].as_uri())
        return page

    yield open_
    for context in contexts:
        context.close()
    assert not told
    assert [url for own, url in requested if url != own and not url.startswith("data:")] == []


@pytest.mark.parametrize("name", ["run", "experiments", "evil"])
def test_it_fits_every_width_and_shows_every_picture(opened: Opened, name: str) -> None:
    page = opened(name)
    for width in WIDTHS:
        page.set_viewport_size({"width": width, "height": 800})
        page.evaluate("document.querySelectorAll('details').forEach((x) => (x.open = true))")
        assert page.evaluate("document.documentElement.scrollWidth") == width
        wider = "[...document.querySelectorAll('main *')].filter((e) => !e.closest('.box') && e.checkVisibility() && "
        wider += "e.getBoundingClientRect().right > innerWidth + 1).map((e) => e.outerHTML.slice(0, 80))"
        assert page.evaluate(wider) == []
    pictures = page.evaluate("[...document.images].filter((x) => x.src).map((x) => [x.naturalWidth, x.alt])")
    assert pictures and all(width > 0 and alt for width, alt in pictures)
    levels = page.evaluate("[...document.querySelectorAll('h1,h2,h3,h4')].map((x) => Number(x.tagName[1]))")
    assert levels[0] == 1 and levels.count(1) == 1
    assert all(after <= before + 1 for before, after in zip(levels, levels[1:], strict=False))


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_all_text_stands_out(opened: Opened, scheme: str) -> None:
    for name in ("run", "experiments"):
        page = opened(name, color_scheme=scheme)
        page.evaluate("document.querySelectorAll('details').forEach((x) => (x.open = true))")
        assert page.evaluate(CONTRAST) == []
        dark = page.evaluate("getComputedStyle(document.body).backgroundColor") != "rgb(253, 253, 251)"
        assert dark == (scheme == "dark")


def test_parts_fold_and_tables_scroll_in_their_boxes(opened: Opened) -> None:
    page = opened("evil", 360)
    fold = page.locator("details", has_text="Every context")
    inside = fold.locator("table")
    assert not inside.is_visible()
    fold.locator("summary").click()
    assert inside.is_visible()
    box = fold.locator(".box")
    size = box.evaluate("(x) => [x.scrollWidth > x.clientWidth, x.scrollHeight > x.clientHeight, x.clientHeight]")
    assert size[0] and size[1] and size[2] < 700
    moved = box.evaluate("(x) => { x.scrollTo(200, 300); return [x.scrollLeft, x.scrollTop]; }")
    assert moved == [200, 300]
    head, edge = fold.locator("thead th").first.bounding_box(), box.bounding_box()
    assert abs(head["x"] - edge["x"]) < 3 and abs(head["y"] - edge["y"]) < 3  # it stays in sight
    assert page.evaluate("scrollX") == 0
    fold.locator("summary").click()
    assert not inside.is_visible()


def test_a_picture_opens_in_full_size_and_closes(opened: Opened) -> None:
    page = opened("run", 360)
    large, url = page.locator("#zoom img"), page.url
    assert not large.is_visible()
    page.locator("[data-zoom]").first.click()
    shown = large.evaluate("(x) => [x.naturalWidth, x.getBoundingClientRect().width, x.alt.length]")
    assert large.is_visible() and shown[0] > 0 and shown[1] >= 900 and shown[2] > 0
    assert page.evaluate("(x => x.scrollWidth > x.clientWidth)(document.querySelector('.pane'))")
    page.keyboard.press("Escape")
    assert not large.is_visible()
    page.locator("[data-zoom]").first.focus()
    page.keyboard.press("Enter")
    assert large.is_visible()
    page.get_by_role("button", name="Close").click()
    assert not large.is_visible() and page.url == url


def test_links_lead_to_files_that_the_browser_finds(opened: Opened, pages: dict[str, Path]) -> None:
    from urllib.parse import unquote, urlsplit

    for name in ("run", "experiments", "evil"):
        page = opened(name)
        links = page.evaluate("[...document.links].map((x) => x.href).filter((x) => !x.includes('#'))")
        assert links and all(link.startswith("file:///") for link in links)
        assert [link for link in links if not Path(unquote(urlsplit(link).path)).exists()] == []


def test_it_prints_on_a4(opened: Opened, tmp_path: Path) -> None:
    page = opened("run", color_scheme="dark")
    content = page.pdf(prefer_css_page_size=True, print_background=True)
    sizes = set(re.findall(rb"/MediaBox ?\[([^\]]*)\]", content))
    count = len(re.findall(rb"/Type ?/Page\b", content))
    assert [round(float(x)) for x in sizes.pop().split()] in ([0, 0, 595, 842], [0, 0, 596, 842]) and not sizes
    assert 2 <= count <= 8
    page.emulate_media(media="print")
    hidden = "(s) => [...document.querySelectorAll(s)].every((x) => !x.checkVisibility())"
    assert page.evaluate(hidden, "nav, .formats, #files, details.unprinted *, button, .skip")
    assert page.evaluate("getComputedStyle(document.body).backgroundColor") == "rgb(255, 255, 255)"
    assert page.evaluate(
        "[...document.querySelectorAll('.box')].every((x) => getComputedStyle(x).overflowX === 'visible')"
    )
    inside = page.evaluate("getComputedStyle(document.querySelector('figure')).breakInside")
    assert inside == "avoid" and page.evaluate(CONTRAST) == []
    config = page.locator("details.printed pre").first
    assert config.evaluate("(x) => x.getBoundingClientRect().height") > 200  # folded on the screen, open on paper
