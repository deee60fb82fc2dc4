"""The page of a run: everything that the run directory holds, and nothing that is not escaped."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from typer.testing import CliRunner

from dsfit.cli import app
from dsfit.errors import InputError
from dsfit.report import write_report
from tests.report.conftest import RunOf
from tests.report.reading import check_references, parse

CLI = CliRunner()
QUICK = ("compare", "check", "render")
SLOW = ("sweep", "transmittance", "race", "amortise", "compare_render")
EVIL = "</title><script>alert(1)</script><img src=x onerror=alert(2)> \" ' {{ 7*7 }} `a` &amp; \x1b[31m\x00\u202e\ud800"


def rewrite(folder: Path, change: Any) -> None:
    """Change result.json in place."""
    path = folder / "result.json"
    data = json.loads(path.read_text())
    change(data)
    path.write_text(json.dumps(data))


@pytest.mark.parametrize("kind", [*QUICK, *(pytest.param(kind, marks=pytest.mark.slow) for kind in SLOW)])
def test_a_page_shows_all_that_the_run_holds(run_of: RunOf, kind: str) -> None:
    folder = run_of(kind)
    page = parse(folder / "report.html")
    files = check_references(folder / "report.html")
    figures = sorted(folder.glob("figures/*.png"))
    assert set(figures) <= set(files) and {folder / "result.json", folder / "config.toml"} <= set(files)
    shown = [attributes for attributes in page.all("img") if "src" in attributes]
    assert len(shown) == len(figures) + (folder / "image.png").is_file()
    assert all(attributes["alt"] and int(attributes["width"]) > 0 for attributes in shown)
    rows = [line for line in (folder / "table.md").read_text().splitlines() if line.startswith("| ")]
    first = [cell.strip() for cell in re.split(r"(?<!\\)\|", rows[-1])[1:-1]]
    assert len(page.all("table")) >= 1 and all(cell.replace("\\|", "|") in page.text for cell in first)
    record = json.loads((folder / "provenance.json").read_text())
    assert all(word in page.text for word in (record["dsfit"], record["python"], "dsfit run config.toml"))
    assert (folder / "config.toml").read_text().strip() in page.text
    headings = [int(tag[1]) for tag, _ in page.tags if re.fullmatch("h[1-6]", tag)]
    assert headings[0] == 1 and headings.count(1) == 1
    assert all(after <= before + 1 for before, after in zip(headings, headings[1:], strict=False))


def test_the_same_files_give_the_same_bytes_and_another_place_other_links(run_of: RunOf, tmp_path: Path) -> None:
    folder = run_of("compare")
    before = (folder / "report.html").read_bytes()
    elsewhere = write_report(folder, tmp_path / "pages" / "one.html")
    assert write_report(folder, folder / "report.html").read_bytes() == before
    assert elsewhere.read_bytes() != before
    assert folder / "result.json" in [path.resolve() for path in check_references(elsewhere)]
    assert [path.name for path in elsewhere.parent.iterdir()] == ["one.html"]


def test_markup_in_titles_names_labels_and_logs_is_text(copy_of: RunOf) -> None:
    folder = copy_of("compare")

    def change(data: dict[str, Any]) -> None:
        data["title"] = data["name"] = EVIL
        data["provenance"]["dsfit"] = data["provenance"]["machine"]["processor"] = EVIL
        data["provenance"]["packages"] = {EVIL: EVIL}
        data["provenance"]["sessions"][0]["started"] = EVIL
        for cell in data["cells"]:
            cell["label"] = EVIL
            cell["methods"][1]["name"] = f"{EVIL}|x"

    rewrite(folder, change)
    (folder / "config.toml").write_bytes(EVIL.encode(errors="surrogatepass") + b"\xff\xfe </code></pre><script>")
    (folder / "figures" / "a'><script>alert(3)<x>\".png").write_bytes((folder / "figures" / "excess.png").read_bytes())
    (folder / "figures" / "javascript:alert(4).png").write_bytes(b"<svg onload=alert(5)>")
    path = write_report(folder)
    page = parse(path)
    check_references(path)
    assert len(page.all("script")) == 1 and len(page.all("title")) == 1 and not page.all("svg")
    assert all(attributes.get("src", "data:").startswith("data:") for attributes in page.all("img"))
    assert "<script>alert(1)</script>" in page.text and "{{ 7*7 }}" in page.text and "onerror=alert(2)" in page.text
    assert not re.search("[\x00\x1b\u202e]", path.read_text())


@pytest.mark.parametrize("kind", ["compare", "check", pytest.param("render", marks=pytest.mark.slow)])
def test_a_damaged_result_gives_a_page_that_says_so(copy_of: RunOf, kind: str) -> None:
    folder = copy_of(kind)
    whole = json.loads((folder / "result.json").read_text())
    for key in whole:
        for junk in ("missing", None, 7, "text", [None], [{"index": {}, "methods": 3}], {"a": {}}):
            broken = {k: v for k, v in whole.items() if k != key} if junk == "missing" else {**whole, key: junk}
            (folder / "result.json").write_text(json.dumps(broken))
            page = parse(write_report(folder))
            assert "What came out" in page.text and "Environment" in page.text
            if key == {"compare": "cells", "check": "report", "render": "image"}[kind]:
                assert "damaged" in page.text
    for content in (b"", b"{", b"\xff\x00", b"[]", b'{"schema_version": 99}', b"[" * 100_000):
        (folder / "result.json").write_bytes(content)
        assert "unfinished" in parse(write_report(folder)).text


def test_an_unfinished_run_tells_which_cells_failed(copy_of: RunOf) -> None:
    folder = copy_of("compare")
    (folder / "result.json").unlink()
    (folder / "provenance.json").write_text("{")
    (folder / "cells" / "0001.error.txt").write_text("Traceback\nValueError: <b>no</b>\n")
    page = parse(write_report(folder))
    assert "unfinished" in page.text and "cell 0001: ValueError: <b>no</b>" in page.text and "<b>no</b>" in page.text
    assert "provenance.json is missing or damaged" in page.text


def test_pictures_that_are_missing_or_damaged_leave_a_note(copy_of: RunOf) -> None:
    folder = copy_of("compare")
    (folder / "figures" / "excess.png").unlink()
    (folder / "figures" / "convergence.png").write_bytes((folder / "figures" / "convergence.png").read_bytes()[:3000])
    (folder / "figures" / "big.png").write_bytes(b"")
    page = parse(write_report(folder))
    assert page.text.count("No picture:") == 3 and "excess.png" in page.text
    check_references(folder / "report.html")


def test_nan_and_inf_are_shown(copy_of: RunOf) -> None:
    folder = copy_of("compare")

    def change(data: dict[str, Any]) -> None:
        for cell in data["cells"]:
            cell["methods"][0].update(excess="inf", variance="inf", largest_weight="nan", seconds_to_1_percent="nan")
        data["seconds"] = "nan"

    rewrite(folder, change)
    text = parse(write_report(folder)).text
    assert re.search(r"uniform\s+inf\s+inf\s+-", text)


def test_a_table_of_thousands_of_rows_is_cut_and_says_so(copy_of: RunOf) -> None:
    folder = copy_of("compare")
    rewrite(folder, lambda data: data.update(cells=data["cells"] * 1500))
    page = parse(write_report(folder))
    assert "The first 1000 of 3000 rows" in page.text and "Every context (3000)" in page.text
    assert 1000 < len(page.all("tr")) < 1100 and (folder / "report.html").stat().st_size < 3e6


def test_large_pictures_are_made_to_fit(tmp_path: Path) -> None:
    from dsfit.report.links import Place
    from dsfit.report.pictures import BUDGET, Album, embed

    noise = np.random.default_rng(1).integers(0, 256, (200, 600, 3), dtype=np.uint8)
    Image.fromarray(noise).save(tmp_path / "noise.png", dpi=(192, 192))
    before = (tmp_path / "noise.png").stat().st_size
    source, width, height, note = embed(tmp_path / "noise.png", 45_000)
    assert before > 300_000 and len(source) < 1.4 * 45_000 and "kB" in note
    assert (width, height) == (360, 120)  # 600 at 192 to an inch, a fifth larger than in print
    assert embed(tmp_path / "noise.png", before)[0].startswith("data:image/png") and 200 * 45_000 <= BUDGET
    shown = Album(Place(tmp_path / "page.html"), 230).picture(tmp_path / "noise.png", "what one sees. More.")
    assert len(shown.source) < 1.4 * 45_000 and shown.alt == "noise: what one sees." and shown.full is not None
    Image.new("RGB", (8000, 12_000)).save(tmp_path / "huge.png")
    assert "too large" in Album(Place(tmp_path / "page.html"), 1).picture(tmp_path / "huge.png", "").note


def test_one_clear_error_for_what_is_no_run(tmp_path: Path) -> None:
    for folder in (tmp_path, tmp_path / "nowhere", tmp_path / ("x" * 300)):
        found = CLI.invoke(app, ["report", str(folder)])
        assert found.exit_code == 2 and found.output.startswith("dsfit: ") and found.output.count("\n") == 1
    (tmp_path / "config.toml").write_text("")
    found = CLI.invoke(app, ["report", str(tmp_path), "--out", str(tmp_path)])
    assert found.exit_code == 2 and "--out" in found.output
    (tmp_path / "file").write_text("")
    assert CLI.invoke(app, ["report", str(tmp_path), "--out", str(tmp_path / "file" / "x.html")]).exit_code == 1
    assert not list(tmp_path.glob(".*tmp")) and not (tmp_path / "report.html").exists()
    with pytest.raises(InputError):
        write_report(tmp_path / "file")
    found = CLI.invoke(app, ["report", str(tmp_path)])
    assert found.exit_code == 0 and str(tmp_path / "report.html") in found.output


def test_drawing_a_run_writes_its_page_and_force_removes_it(copy_of: RunOf) -> None:
    from dsfit.experiment.rundir import RunDirectory

    folder = copy_of("check")
    before = write_report(folder).read_bytes()  # of this folder, whose name it tells
    (folder / "report.html").unlink()
    assert CLI.invoke(app, ["show", str(folder)]).exit_code == 0 and not (folder / "report.html").exists()
    found = CLI.invoke(app, ["show", str(folder), "--plots"])
    assert found.exit_code == 0 and f"report:    {folder / 'report.html'}" in found.output
    assert (folder / "report.html").read_bytes() == before
    RunDirectory(folder).clear()
    assert not (folder / "report.html").exists()
