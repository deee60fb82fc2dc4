"""The page of one run directory."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from dsfit.errors import InputError
from dsfit.experiment.files import number
from dsfit.experiment.rundir import RunDirectory
from dsfit.report import captions, environment, markdown
from dsfit.report.environment import items, mapping
from dsfit.report.links import Place
from dsfit.report.page import Block, Code, Facts, Files, Fold, Page, Picture, Section, Table, Text, Verdict
from dsfit.report.pictures import Album

DAMAGE = (LookupError, TypeError, ValueError, AttributeError, ArithmeticError)
"""What reading a damaged result may raise (InputError is a ValueError)."""

_KINDS = {
    "compare": "Comparison of methods",
    "sweep": "Sweep over a grid",
    "transmittance": "Transmittance",
    "check": "Check",
    "race": "Race",
    "amortise": "Amortised proposals",
    "render": "Rendering",
    "compare_render": "Comparison on an image",
}
_MOST_PICTURES = 80
_MOST_METHODS = 12


def run_page(folder: Path, place: Place) -> Page:
    """The page of a run: finished, unfinished, or damaged."""
    directory = RunDirectory(folder)
    try:
        result, problem = directory.result(), ""
    except InputError as error:
        result, problem = {}, f"{Path(error.field).name}: {error.value}"
    provenance = mapping(result.get("provenance")) or directory.provenance()
    verdict = _unfinished(folder, problem) if problem else _guarded(lambda: _verdict(result), _damaged)
    title = str(result.get("title") or result.get("name") or folder.absolute().name)
    sections = [
        Section("result", "What came out", [verdict, *_tables(result), *_by_context(result)]),
        Section("figures", "Figures", _figures(folder, result, place)),
        Section("asked", "What was asked", asked(folder, place)),
        Section("environment", "Environment", _environment(provenance, result)),
        Section("files", "Files", _files(folder, place), printed=False),
    ]
    kind = _KINDS.get(str(result.get("kind")), "Run")
    return Page(kind, title, verdict, _facts(folder, result, provenance), [s for s in sections if s.blocks])


def _guarded(make: Callable[[], Any], otherwise: Callable[[str], Any]) -> Any:
    try:
        return make()
    except DAMAGE as error:
        return otherwise(f"{type(error).__name__}: {error}"[:200])


def _damaged(reason: str) -> Verdict:
    return Verdict("fail", "damaged", [f"result.json lacks what a result has ({reason})."])


def _unfinished(folder: Path, problem: str) -> Verdict:
    cells = len(list(folder.glob("cells/*.json")))
    lines = [f"{problem}. {cells} cells are done; `dsfit run` with the same config goes on from there."]
    for path in sorted(folder.glob("cells/*.error.txt"))[:5]:
        text = path.read_bytes()[-4000:].decode(errors="replace").strip().splitlines()
        lines.append(f"cell {path.name.split('.')[0]}: {text[-1] if text else 'no reason given'}"[:400])
    return Verdict("fail", "unfinished", lines)


def _verdict(result: dict[str, Any]) -> Verdict:
    kind = result["kind"]
    if kind == "check":
        from dsfit.experiment.check_report import verdict_line

        report = result["report"]
        unclear = " Unclear findings are no failures: there the data could not tell." if report["unclear"] else ""
        passed = report["verdict"] == "pass"
        word = "checks passed" if passed else "checks failed"
        return Verdict("pass" if passed else "fail", word, [verdict_line(result) + "." + unclear])
    if kind == "race":
        return _race(result)
    if kind == "compare_render":
        return _compared(result)
    if kind in ("compare", "sweep"):
        bad = [cell["label"] for cell in result["cells"] if not cell["reference"]["converged"]]
        if bad:
            return Verdict("unclear", "measured", ["The quadrature did not converge at: " + "; ".join(bad[:10]) + "."])
        told = "The quadrature converged at every context. A run of this kind measures; `dsfit check` judges."
        return Verdict("none", "measured", [told])
    return Verdict("none", "measured", ["A run of this kind measures; `dsfit check` judges."])


def _race(result: dict[str, Any]) -> Verdict:
    from dsfit.experiment.race import failed
    from dsfit.experiment.race_summary import entrants

    found = entrants(result["cells"])
    biased, heavy = failed(result), [e.name for e in found if e.skipped is None and e.heavy]
    skipped = [f"{e.name} ({e.skipped})" for e in found if e.skipped]
    lines = [f"Estimates off the truth: {', '.join(biased)}."] if biased else []
    lines += [f"Heavy tails, error understated: {', '.join(heavy)}."] if heavy else []
    lines += [f"Not run: {'; '.join(skipped)}."] if skipped else []
    ran = sum(e.skipped is None for e in found)
    if biased:
        return Verdict("fail", f"{len(biased)} of {ran} peers biased", lines)
    return Verdict("pass", "no peer biased", lines or [f"The estimates of all {ran} peers agree with the truth."])


def _compared(result: dict[str, Any]) -> Verdict:
    from dsfit.experiment.compare_render_summary import reference_of

    cells = result["cells"][1:]
    failed = [f"{c['technique']} ({c['failed']})" for c in cells if c.get("failed")]
    biased = [c["technique"] for c in cells if c.get("biased")]
    heavy = [c["technique"] for c in cells if c.get("heavy")]
    agrees = reference_of(result)["check"]["verdict"] == "agree"
    lines = [f"The reference {'agrees with' if agrees else 'DIFFERS from'} its independent check."]
    lines += [f"Failed: {'; '.join(failed)}."] if failed else []
    lines += [f"Off the reference: {', '.join(biased)}."] if biased else []
    lines += [f"Heavy tails, error understated: {', '.join(heavy)}."] if heavy else []
    good = agrees and not failed and not biased
    return Verdict("pass" if good else "fail", "reference confirmed" if good else "not all is well", lines)


def _tables(result: dict[str, Any]) -> list[Block]:
    if not result:
        return []
    from dsfit.experiment import summary

    title = str(result.get("title") or result.get("name") or "")

    def made() -> list[Block]:
        found = markdown.blocks(summary.markdown(result), title)
        if result["kind"] == "check":  # the verdict stands above already
            found = [b for b in found if not isinstance(b, Text)]
        return found

    return _guarded(made, lambda reason: [Text([f"The tables cannot be made: result.json is damaged ({reason})."])])


def _by_context(result: dict[str, Any]) -> list[Block]:
    """Excess of every method at every context, folded away."""
    if result.get("kind") not in ("compare", "sweep"):
        return []

    def made() -> list[Block]:
        cells = result["cells"]
        names = [method["name"] for method in cells[0]["methods"]][:_MOST_METHODS]
        rows = [
            [cell["label"], *(f"{number(method['excess']):.3g}" for method in cell["methods"][: len(names)])]
            for cell in cells
        ]
        shown = rows[: markdown.MOST_ROWS]
        notes = ["Every number of every context is in result.json."]
        table = Table(
            "Excess at every context", ["context", *names], shown, "l" + "r" * len(names), notes,
            left_out=len(rows) - len(shown),
        )  # fmt: skip
        return [Fold(f"Every context ({len(rows)})", [table])]

    return _guarded(made, lambda reason: []) if len(items(result.get("cells"))) > 1 else []


def _figures(folder: Path, result: dict[str, Any], place: Place) -> list[Block]:
    paths = [folder / "image.png"] if (folder / "image.png").is_file() else []
    paths += sorted(folder.glob("figures/*.png"), key=lambda path: captions.order(path.stem))
    known = {path.stem for path in paths}
    missing = [p for p in sorted(folder.glob("figures/*.pdf")) if p.stem not in known]
    paths += [path.with_suffix(".png") for path in missing]
    album = Album(place, min(len(paths), _MOST_PICTURES))
    found: list[Block] = [_picture(album, path, result) for path in paths[:_MOST_PICTURES]]
    if len(paths) > _MOST_PICTURES:
        found.append(Text([f"{len(paths) - _MOST_PICTURES} more figures are in the folder."]))
    return found


def _picture(album: Album, path: Path, result: dict[str, Any]) -> Picture:
    name, caption = captions.caption(path.stem, result)
    return album.picture(path, caption, name)


def asked(folder: Path, place: Place, command: str = "dsfit run config.toml") -> list[Block]:
    """The config, and the command that takes it."""
    path = folder / "config.toml"
    try:
        text = path.read_bytes().decode(errors="replace")
    except OSError as error:
        return [Text([f"config.toml is missing ({error.strerror})."])]
    return [
        Text(["Every setting, those left to their defaults too. The same numbers, all but the seconds, come from:"]),
        Code(command, "command"),
        Fold("config.toml", [Code(text, "config.toml"), Files([place.link(path)])], printed=True),
    ]


def _environment(provenance: Any, result: dict[str, Any]) -> list[Block]:
    head, rows = environment.sessions(provenance)
    load = environment.load(items(result.get("cells")))
    found = environment.facts(provenance)
    blocks: list[Block] = [Facts([*found, *([("load", load)] if load else [])])] if found else []
    if rows:
        blocks.append(Table("Sittings", head, rows[: markdown.MOST_ROWS], "llrrr"))
    return blocks or [Text(["provenance.json is missing or damaged."])]


def _files(folder: Path, place: Place) -> list[Block]:
    names = ("result.json", "table.md", "config.toml", "provenance.json", "image.exr", "image.png")
    own = [folder / name for name in names]
    for name in ("images", "proposals"):
        own += sorted(path for path in folder.glob(f"{name}/*") if path.suffix != ".png")
    cells = sorted(folder.glob("cells/[0-9]*.*"))
    blocks: list[Block] = [place.files(own, folder)]
    if cells:
        blocks.append(Fold(f"Cells ({len(cells)} files)", [place.files(cells, folder)]))
    return blocks


def _facts(folder: Path, result: dict[str, Any], provenance: Any) -> list[tuple[str, str]]:
    sittings = [mapping(one) for one in items(provenance.get("sessions"))]
    started = environment.moment(sittings[0].get("started")) if sittings else ""
    cells = len(items(result.get("cells")))
    found = [
        ("run", folder.absolute().name),
        ("started", started),
        ("wall time", environment.duration(result.get("seconds"))),
        ("cells", str(cells) if cells else ""),
        ("seed", "" if provenance.get("seed") is None else str(provenance["seed"])),
        ("precision", str(provenance.get("dtype") or "")),
        ("commit", environment.commit(provenance)),
    ]
    return [(name, value) for name, value in found if value]
