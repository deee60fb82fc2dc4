"""The page of an output directory of `dsfit figures`: every experiment with its figures, tables and standing."""

from __future__ import annotations

import shlex
from collections import Counter
from pathlib import Path
from typing import Any

from dsfit.experiment.files import to_toml
from dsfit.figures.latex import escape
from dsfit.figures.state import in_order
from dsfit.report import environment, markdown
from dsfit.report.environment import items, mapping
from dsfit.report.links import Place
from dsfit.report.page import Block, Code, Facts, Fold, Page, Section, Table, Text, Verdict
from dsfit.report.pictures import Album
from dsfit.report.standing import Standing, standings
from dsfit.report.verification import Verification, verification

TITLE = "Figures and tables"


def figures_page(out: Path, place: Place, root: Path) -> Page:
    """The page of the whole set."""
    found = standings(out, root)
    checked = verification(out, {one.name: one.computed.get("data") for one in found})
    album = Album(place, sum(len(_pictures(one)) for one in found))
    sections = [Section("overview", "Overview", _overview(out, found, checked, place))]
    for k, one in enumerate(found):
        blocks = _experiment(one, checked, album, place)
        sections.append(Section(f"experiment-{k + 1}", one.title, blocks, one.verdict))
    sections.append(Section("environment", "Environment", _environments(found)))
    sections = [section for section in sections if section.blocks]
    verdict = _verdict(found, checked)
    return Page("Figures by name", TITLE, verdict, _facts(found), sections)


def _files_of(one: Standing, kind: str, suffix: str) -> list[Path]:
    """Its figures or tables in the order in which they were drawn, those that are gone among them, then others."""
    drawn = in_order(mapping(one.drawn.get(kind)))
    known = [one.folder / kind / f"{name}{suffix}" for name in drawn if "/" not in name and "\0" not in name]
    return [*known, *sorted({*one.folder.glob(f"{kind}/*{suffix}")} - {*known})]


def _pictures(one: Standing) -> list[Path]:
    return _files_of(one, "figures", ".png")


def _verdict(found: list[Standing], checked: Verification) -> Verdict:
    counts = Counter(one.verdict.word for one in found)
    lines = [f"{len(found)} experiments: " + ", ".join(f"{n} {word}" for word, n in sorted(counts.items())) + "."]
    states = {one.verdict.state for one in found}
    if checked.verdict is not None:
        lines += checked.verdict.lines
        states.add(checked.verdict.state)
    bad = [one.name for one in found if one.verdict.state == "fail"]
    if "fail" in states:
        word = f"{len(bad)} of {len(found)} failed" if bad else "not reproduced"
        return Verdict("fail", word, [*([f"Failed: {', '.join(bad)}."] if bad else []), *lines])
    if states & {"unclear", "none"}:
        return Verdict("unclear", "not all up to date", lines)
    return Verdict("pass", "all up to date" if checked.verdict is None else "all up to date and reproduced", lines)


def _facts(found: list[Standing]) -> list[tuple[str, str]]:
    seconds = [float(s) for one in found if isinstance(s := one.computed.get("seconds"), int | float)]
    commits = sorted({environment.commit(mapping(one.computed.get("provenance"))) for one in found if one.computed})
    days = sorted(str(one.computed.get("started", ""))[:10] for one in found if one.computed)
    facts = [
        ("experiments", str(len(found))),
        ("figures", str(sum(len(_pictures(one)) for one in found))),
        ("computed", days[0] if days and days[0] == days[-1] else f"{days[0]} to {days[-1]}" if days else ""),
        ("time, all together", environment.duration(sum(seconds)) if seconds else ""),
        ("commit", ", ".join(c for c in commits if c) if len(commits) < 3 else f"{len(commits)} different ones"),
    ]
    return [(name, value) for name, value in facts if value]


def _overview(out: Path, found: list[Standing], checked: Verification, place: Place) -> list[Block]:
    rows = []
    for one in found:
        minutes = _plain_number(one.told.get("minutes"))
        took = environment.duration(one.computed.get("seconds"))
        rows.append([one.name, one.title, one.verdict.word, *checked.words(one.name), minutes, took])
    head = ["experiment", "title", "state", *checked.head, "minutes, one core", "took"]
    align = "lll" + "l" * len(checked.head) + "rr"
    blocks: list[Block] = [
        Text(
            [
                "Every experiment below is made by name: `dsfit figures run NAME` computes what is out of date and "
                "draws it, `dsfit figures run` makes all of them, and `--set KEY=VALUE` changes a setting."
            ]
        ),
        Table("What there is", head, rows, align),
    ]
    if checked.verdict is not None:
        blocks.append(checked.verdict)
    return [*blocks, place.files([out / name for name in ("manifest.json", "verify.json", "thesis.tex")], out)]


def _experiment(one: Standing, checked: Verification, album: Album, place: Place) -> list[Block]:
    shows = str(one.told.get("shows") or "")
    blocks: list[Block] = []
    if one.verdict.state != "pass":
        blocks.append(one.verdict)
    if shows:
        blocks.append(Text([shows]))
    blocks.append(Code(_command(one), f"command of {one.name}"))
    if one.log:
        blocks.append(Fold("The end of log.txt", [Code(one.log, f"log of {one.name}", wrap=True)], open=True))
    for path in _pictures(one):
        caption = _caption(one, path.stem)
        blocks.append(album.picture(path, "" if caption == shows else caption, _words(path.stem), alt=caption))
    blocks += _tables(one, place)
    blocks += checked.blocks(one.name)
    if facts := _times(one):
        blocks.append(Facts(facts))
    return [*blocks, *_folds(one, place)]


def _caption(one: Standing, figure: str) -> str:
    known = mapping(mapping(one.drawn.get("figures")).get(figure))
    return str(known.get("caption") or one.told.get("shows") or "")


def _words(stem: str) -> str:
    text = stem.replace("_", " ").replace("-", " ").strip() or stem
    return text[0].upper() + text[1:]


def _tables(one: Standing, place: Place) -> list[Block]:
    found: list[Block] = []
    for path in _files_of(one, "tables", ".md"):
        others = [path, path.with_suffix(".tex")]
        links = [place.link(p, {".md": "Markdown", ".tex": "LaTeX"}[p.suffix], " ") for p in others if p.is_file()]
        try:
            text = path.read_bytes().decode(errors="replace")
        except OSError as error:
            found.append(Text([f"{path.name} cannot be read ({error.strerror})."]))
            continue
        for block in markdown.blocks(text, links=links):
            found.append(_captioned(block) if isinstance(block, Table) else block)
    return found


def _captioned(table: Table) -> Table:
    """Below the Markdown table stands its caption; on the page it stands above."""
    caption = table.caption or " ".join(table.notes)
    notes = table.notes if table.caption else ()
    return Table(caption, table.head, table.rows, table.align, notes, table.links, table.left_out)


def _command(one: Standing) -> str:
    changes = "".join(f" --set {shlex.quote(change)}" for change in one.changes)
    return f"dsfit figures run {shlex.quote(one.name)}{changes}"


def _times(one: Standing) -> list[tuple[str, str]]:
    minutes = _plain_number(one.told.get("minutes"))
    processor = environment.duration(one.computed.get("cpu_seconds"))
    found = [
        ("takes", f"about {minutes} min on one quiet core" if minutes else ""),
        ("took", environment.duration(one.computed.get("seconds")) + (f", {processor} CPU" if processor else "")),
        ("computed", environment.moment(one.computed.get("started"))),
        ("needs", ", ".join(map(str, items(one.told.get("needs"))))),
    ]
    return [(name, value) for name, value in found if value]


def _plain_number(value: Any) -> str:
    return f"{value:g}" if isinstance(value, int | float) else ""


def _folds(one: Standing, place: Place) -> list[Block]:
    found: list[Block] = []
    if one.told:
        found.append(Fold("What “reproduced” means here", _rules(one), printed=True))
    settings = mapping(one.computed.get("settings"))
    if settings:
        text = to_toml({key: settings[key] for key in sorted(settings)})
        found.append(Fold("Settings", [Code(text, f"settings of {one.name}")], printed=True))
    if snippet := _latex(one):
        found.append(Fold("LaTeX", [Code(snippet, f"LaTeX of {one.name}")]))
    paths = sorted(path for path in one.folder.glob("*") if not path.name.startswith("."))
    paths += sorted(path for name in ("figures", "tables", "files") for path in one.folder.glob(f"{name}/**/*"))
    listed = place.files(paths, one.folder)
    if listed.links:
        found.append(Fold(f"Files ({len(listed.links) + listed.left_out})", [listed]))
    return found


def _rules(one: Standing) -> list[Block]:
    rules = [[str(pattern), str(rule)] for pattern, rule in mapping(one.told.get("reproduces")).items()]
    rest = "everything else" if rules else "everything"
    told = "`dsfit figures verify` compares a new run with stored data; of the patterns, the first that fits counts."
    return [Text([told]), Table("Values and how they agree", ["values", "agree"], [*rules, [rest, "equal"]], "ll")]


def _latex(one: Standing) -> str:
    """What a thesis has to say to have the figures and tables, from the output directory."""
    parts = []
    for path in _pictures(one):
        pdf = path.with_suffix(".pdf")
        if not pdf.is_file() or not _plain(path.stem) or not _plain(one.name):
            continue
        parts.append(
            "\\begin{figure}\n  \\centering\n"
            f"  \\includegraphics[width=\\linewidth]{{{one.name}/figures/{pdf.name}}}\n"
            f"  \\caption{{{escape(_caption(one, path.stem))}}}\n"
            f"  \\label{{fig:{one.name}:{path.stem}}}\n\\end{{figure}}"
        )
    for path in sorted(one.folder.glob("tables/*.tex")):
        if _plain(path.stem) and _plain(one.name):
            parts.append(f"\\input{{{one.name}/tables/{path.name}}}")
    return "\n\n".join(parts)


def _plain(name: str) -> bool:
    """Whether LaTeX takes it in a path and a label as it is."""
    return bool(name) and all(c.isascii() and (c.isalnum() or c in "-_.") for c in name)


def _environments(found: list[Standing]) -> list[Block]:
    """Every different origin of data once, with the experiments that share it."""
    groups: dict[tuple[tuple[str, str], ...], list[str]] = {}
    for one in found:
        facts = environment.facts(mapping(one.computed.get("provenance")))
        if facts:
            groups.setdefault(tuple(facts), []).append(one.name)
    blocks: list[Block] = []
    for facts, members in groups.items():
        if len(groups) > 1:
            blocks.append(Text([", ".join(members) + ":"]))
        blocks.append(Facts(facts))
    return blocks
