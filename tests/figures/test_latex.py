"""Text and tables in LaTeX: escaped, within the page, and set by pdflatex."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest

from dsfit.figures import Table, latex
from dsfit.figures.catalogue import find
from dsfit.figures.latex import escape
from dsfit.figures.make import Look, make
from dsfit.figures.manifest import write_manifest

needs_tex = pytest.mark.skipif(shutil.which("pdflatex") is None, reason="no pdflatex")
KNOWN = "".join([*latex._ASCII, *latex._TEXT, *latex._GREEK, *latex._SIGNS, *latex._LETTERS])


def compile_tex(path: Path) -> str:
    """Compile twice; returns the log of the second time."""
    command = ["pdflatex", "-interaction=nonstopmode", "-halt-on-error", path.name]
    for _ in range(2):
        done = subprocess.run(command, cwd=path.parent, capture_output=True, timeout=300)
        assert done.returncode == 0, done.stdout.decode(errors="replace")[-2000:]
    return done.stdout.decode(errors="replace")


def document(path: Path, body: str) -> Path:
    packages = ",".join(latex.PACKAGES)
    head = r"\documentclass[11pt]{article}\usepackage[T1]{fontenc}\usepackage{lmodern,textcomp," + packages
    path.write_text(head + r"}\usepackage[textwidth=150mm]{geometry}\begin{document}" + body + r"\end{document}")
    return path


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("50 % of a&b", r"50 \% of a\&b"),
        ("name_of_x", r"name\_of\_x"),
        ("a\\b{c}", r"a\textbackslash{}b\{c\}"),
        ("--set", "-{}-set"),
        ("θ / °", r"\ensuremath{\theta} / \textdegree{}"),
        ("∫ σ₁₂", r"\ensuremath{\int} \ensuremath{\sigma}\ensuremath{_{12}}"),
        ("10⁻⁶", r"10\ensuremath{^{-6}}"),
        ("x ≤ 3 × μ", r"x \ensuremath{\leq} 3 \ensuremath{\times} \ensuremath{\mu}"),
        ("a_f^n", r"\ensuremath{a_{f}^{n}}"),
        ("θ_max", r"\ensuremath{\ensuremath{\theta}_{\mathrm{max}}}"),
        ("Šidák", r"\v{S}id\'{a}k"),
        ("☃", "[U+2603]"),
        ("$x$ #1 ~^", r"\$x\$ \#1 \textasciitilde{}\textasciicircum{}"),
    ],
)
def test_escape(text: str, expected: str):
    assert escape(text) == expected


def test_all_known_signs_become_ascii():
    assert escape(KNOWN).isascii() and "[U+" not in escape(KNOWN)


@needs_tex
def test_tables_of_all_kinds_compile_within_the_line(tmp_path: Path):
    sentence = "A long sentence, with [brackets] and 50 % of everything, that says what a formula means. " * 3
    tables = [
        Table("signs", " ".join(KNOWN), ["head & all", "θ / °"], [["[first]", "a\\\\b"], ["", "%"]]),
        Table("wide", "Wide.", ["name", *(f"column {k}" for k in range(16))], [["x", *["123.4567"] * 16]] * 3),
        Table("words", "Words.", ["what", "why", "how", "n"], [["short", sentence, sentence[:80], "3"]] * 4, "lllr"),
        Table("long", "Long.", ["k", "square"], [[str(k), f"{k * k}"] for k in range(120)]),
        Table("both", "Long and wide.", ["k", "why", "n"], [[str(k), sentence, "1"] for k in range(50)]),
        Table("empty", "Nothing.", ["a", "b"], []),
        Table("many", "Many.", list("abcdefgh"), [["1234567.8"] * 8 for _ in range(60)]),
    ]
    log = compile_tex(document(tmp_path / "t.tex", "\n".join(table.latex() for table in tables)))
    assert "Overfull" not in log


def test_table_has_rules_caption_and_label():
    text = Table("a_b", "About x_y.", ["k", "v"], [["a&b", "1"]]).latex("tab:here")
    for part in (r"\toprule", r"\midrule", r"\bottomrule", r"\caption{About \ensuremath{x_{y}}.}",
                 r"\label{tab:here}", r"a\&b & 1"):  # fmt: skip
        assert part in text
    assert r"\label{tab:a_b}" in Table("a_b", "", ["k"], [["1"]]).latex()


@needs_tex
def test_a_thesis_with_pgf_figures_compiles(add, tmp_path: Path):
    entry = find(add("toy_tex"), "toy_tex")
    make(entry, tmp_path, say=lambda what: None, look=Look(150.0, pgf=True))
    folder = tmp_path / "toy_tex/figures"
    assert {path.name for path in folder.iterdir()} == {
        "curve.png", "curve.pdf", "curve.pgf", "curve-img0.png", "curve-img1.png",
    }  # fmt: skip
    write_manifest(tmp_path)
    text = (tmp_path / "thesis.tex").read_text()
    assert r"\dsfitpgftrue" in text and r"\input{toy_tex/tables/values.tex}" in text
    log = compile_tex(tmp_path / "thesis.tex")
    assert "toy_tex/figures/curve.pgf" in log and "Overfull" not in log and "undefined" not in log
    first = {path.name: path.read_bytes() for path in folder.iterdir()}
    make(entry, tmp_path, say=lambda what: None, look=Look(150.0, pgf=True), force=True, only_draw=True)
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == first


def test_pgf_without_tex_is_refused(add, tmp_path: Path, monkeypatch):
    from typer.testing import CliRunner

    from dsfit.figures import pgf
    from dsfit.figures.command import app

    root = add("toy_notex")
    pgf.tex_system.cache_clear()
    monkeypatch.setattr(pgf.shutil, "which", lambda name: None)
    found = CliRunner().invoke(app, ["draw", "--pgf", "--root", str(root), "--out", str(tmp_path / "out")])
    pgf.tex_system.cache_clear()
    assert found.exit_code == 2 and "pdflatex" in found.stderr
    assert not (tmp_path / "out").exists()
