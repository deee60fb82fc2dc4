"""`dsfit figures`: the figures and tables of the folder `experiments`, by name."""

from __future__ import annotations

import signal
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, NoReturn

import typer
from rich.console import Console
from rich.table import Table

if TYPE_CHECKING:
    from dsfit.figures.catalogue import Entry
    from dsfit.figures.run import Made

app = typer.Typer(help="Figures and tables by name: compute, draw, compare with stored data.", no_args_is_help=True)

Names = Annotated[list[str] | None, typer.Argument(help="Experiments; all of them if left out.")]
Out = Annotated[Path, typer.Option(help="Directory of all experiments.")]
There = Annotated[Path, typer.Argument(help="Directory that `dsfit figures run` has written.")]
Root = Annotated[Path, typer.Option(help="Folder that holds experiments/ and configs/.")]
Width = Annotated[float, typer.Option("--width", min=40, max=400, help="Width of figures in mm.")]
Pgf = Annotated[bool, typer.Option("--pgf", help="Write figures as PGF too; needs a TeX system.")]
Workers = Annotated[int | None, typer.Option(min=1, help="Experiments at once; default: the number of cores.")]
Changes = Annotated[
    list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="Change a setting of the experiments named.")
]
Against = Annotated[Path | None, typer.Option(help="Folder of reference data; default: ROOT/experiments/reference.")]
OUT = Path("runs/figures")
DEVIATES, NOT_COMPARED = 3, 4


@app.command("list")
def list_(
    root: Root = Path(),
    markdown: Annotated[bool, typer.Option("--markdown", help="Print rows for a README.")] = False,
) -> None:
    """List the experiments: what each shows, and what it takes."""
    from dsfit.figures.catalogue import BrokenExperiment, find, names
    from dsfit.figures.listing import markdown_rows

    entries: list[Entry] = []
    broken: list[str] = []
    for name in names(root):
        try:
            entries.append(find(root, name))
        except BrokenExperiment as error:
            broken.append(str(error))
    if markdown:
        print(markdown_rows(entries))
    else:
        table = Table("name", "what it shows", "minutes on one core")
        for entry in entries:
            table.add_row(entry.name, entry.experiment.shows, f"{entry.experiment.minutes:g}")
        Console(width=None if sys.stdout.isatty() else 140).print(table)
    if broken:
        _fail("; ".join(broken), 1)


@app.command()
def run(
    names: Names = None,
    out: Out = OUT,
    root: Root = Path(),
    set_: Changes = None,
    force: Annotated[bool, typer.Option("--force", help="Compute anew what is up to date.")] = False,
    workers: Workers = None,
    width: Width = 150.0,
    pgf: Pgf = False,
) -> None:
    """Compute what is out of date, then draw it. Exits with 1 if one fails; the others are made all the same."""
    _make(names, out, root, set_ or [], workers, width, pgf, force=force)


@app.command()
def draw(
    names: Names = None,
    out: Out = OUT,
    root: Root = Path(),
    workers: Workers = None,
    width: Width = 150.0,
    pgf: Pgf = False,
) -> None:
    """Draw again from the data that are there, whatever code and settings they were computed with."""
    _make(names, out, root, [], workers, width, pgf, only_draw=True)


@app.command()
def verify(out: There = OUT, names: Names = None, root: Root = Path(), against: Against = None) -> None:
    """Compare data with the stored reference data, by each experiment's rules; writes OUT/verify.json.

    Exits with 3 if something deviates, with 4 if something could not be compared.
    """
    from dsfit.errors import InputError
    from dsfit.figures.verify import show, verify_all
    from dsfit.report import write_report

    entries, broken = _entries(root, names)
    try:
        found = verify_all(entries, out, against or root / "experiments" / "reference")
        write_report(out, root=root)
    except InputError as error:
        _fail(str(error), 2)
    show(found, Console(width=None if sys.stdout.isatty() else 160, highlight=False))
    if wrong := [name for name, one in found.items() if one["verdict"] == "deviates"]:
        _fail(f"deviating: {', '.join(wrong)}", DEVIATES)
    missed = [name for name, one in found.items() if one["verdict"] == "not compared"] + [one.name for one in broken]
    if missed:
        _fail(f"not compared: {', '.join(missed)}", NOT_COMPARED)


@app.command()
def accept(out: There = OUT, names: Names = None, root: Root = Path(), against: Against = None) -> None:
    """Store data of OUT as new reference data."""
    from dsfit.errors import InputError
    from dsfit.figures.reference import store

    entries, broken = _entries(root, names)
    wanted = entries if names else [entry for entry in entries if (out / entry.name / "computed.json").is_file()]
    failed = [one.name for one in broken]
    for entry in wanted:
        try:
            size = store(entry, out / entry.name, against or root / "experiments" / "reference")
            print(f"{entry.name:<28} stored, {size / 1000:.0f} kB")
        except InputError as error:
            failed.append(entry.name)
            print(f"{entry.name:<28} refused: {error}")
    if failed or not wanted:
        _fail(f"not stored: {', '.join(failed) or 'nothing is there'}", 1)


@app.command("check-manifest")
def check_manifest_(out: There = OUT) -> None:
    """Check the files of OUT against the hashes in its manifest. Exits with 3 if one is missing or changed."""
    from dsfit.errors import InputError
    from dsfit.figures.manifest import check_manifest

    try:
        count, wrong = check_manifest(out)
    except InputError as error:
        _fail(str(error), 2)
    print("\n".join(wrong) or f"{count} files are as the manifest says")
    if wrong:
        _fail(f"{len(wrong)} differences from the manifest", DEVIATES)


@app.command()
def about(file: Annotated[Path, typer.Argument(help="A PNG, PDF, PGF or EXR file that dsfit wrote.")]) -> None:
    """Tell where a picture comes from: settings, data, code, packages."""
    from dsfit.errors import InputError
    from dsfit.experiment.about import read_about
    from dsfit.experiment.files import to_toml

    try:
        print(to_toml(read_about(file)), end="")
    except InputError as error:
        _fail(str(error), 2)


def _make(
    names: list[str] | None,
    out: Path,
    root: Path,
    changes: list[str],
    workers: int | None,
    width: float,
    pgf: bool,
    force: bool = False,
    only_draw: bool = False,
) -> None:
    from dsfit.errors import InputError
    from dsfit.figures.make import Look
    from dsfit.figures.run import Job, run_all
    from dsfit.report import write_report

    entries, broken = _entries(root, names)
    try:
        if changes and not names:
            raise InputError("--set", changes[0], "the names of the experiments whose settings it changes")
        for entry in entries:
            entry.settings(changes)
        if pgf:
            from dsfit.figures.pgf import tex_system

            tex_system()
    except InputError as error:
        _fail(str(error), 2)
    console = Console(highlight=False, markup=False, stderr=True, soft_wrap=True)
    job = Job(out, changes, force, only_draw, Look(width, pgf), lambda name, what: console.print(f"{name}: {what}"))
    try:
        with _terminable():
            made = broken + run_all(entries, job, workers)
            write_report(out, root=root)
    except KeyboardInterrupt:
        _fail(f"interrupted; the same command goes on from here: {out}", 130)
    except OSError as error:
        _fail(f"{out}: {error}", 1)
    for one in made:
        what = one.failure or ("computed" if one.computed else "drawn" if one.drawn else "up to date")
        print(f"{one.name:<28} {'FAILED ' if one.failure else ''}{what}  {one.seconds:.1f} s")
    failed = [one.name for one in made if one.failure]
    if failed:
        _fail(f"{len(failed)} of {len(made)} failed: {', '.join(failed)}", 1)


def _entries(root: Path, names: Sequence[str] | None) -> tuple[list[Entry], list[Made]]:
    """The experiments, and those whose modules cannot be imported; ends the command where a name is unknown."""
    from dsfit.errors import InputError
    from dsfit.figures import catalogue
    from dsfit.figures.run import Made

    entries, broken = [], []
    for name in dict.fromkeys(names or catalogue.names(root)):
        try:
            entries.append(catalogue.find(root, name))
        except InputError as error:
            _fail(str(error), 2)
        except catalogue.BrokenExperiment as error:
            broken.append(Made(name, str(error)))
    return entries, broken


@contextmanager
def _terminable() -> Iterator[None]:
    """SIGTERM ends things as Ctrl-C does."""

    def stop(number: int, frame: object) -> NoReturn:
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGTERM, stop)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def _fail(message: str, code: int) -> NoReturn:
    typer.echo(f"dsfit: {message}", err=True)
    raise typer.Exit(code)
