"""`dsfit figures list | run | draw`: the figures and tables of the folder `experiments`, by name."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated, NoReturn

import typer
from rich.console import Console
from rich.table import Table

app = typer.Typer(help="Figures and tables by name: compute, draw, compare with stored data.", no_args_is_help=True)

Names = Annotated[list[str] | None, typer.Argument(help="Experiments; all of them if left out.")]
Out = Annotated[Path, typer.Option(help="Directory of all experiments.")]
Root = Annotated[Path, typer.Option(help="Folder that holds experiments/ and configs/.")]
Width = Annotated[float, typer.Option("--width", min=40, max=400, help="Width of figures in mm.")]
Workers = Annotated[int | None, typer.Option(min=1, help="Experiments at once; default: the number of cores.")]
Changes = Annotated[
    list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="Change a setting of the experiments named.")
]
OUT = Path("runs/figures")


@app.command("list")
def list_(root: Root = Path()) -> None:
    """List the experiments: what each shows, and what it takes."""
    from dsfit.figures.catalogue import find, names

    table = Table("name", "what it shows", "minutes on one core")
    for name in names(root):
        experiment = find(root, name).experiment
        table.add_row(name, experiment.shows, f"{experiment.minutes:g}")
    Console(width=None if sys.stdout.isatty() else 140).print(table)


@app.command()
def run(
    names: Names = None,
    out: Out = OUT,
    root: Root = Path(),
    set_: Changes = None,
    force: Annotated[bool, typer.Option("--force", help="Compute anew what is up to date.")] = False,
    workers: Workers = None,
    width: Width = 150.0,
) -> None:
    """Compute what is out of date, then draw it. Exits with 1 if one fails; the others are made all the same."""
    _make(names, out, root, set_ or [], workers, width, force=force)


@app.command()
def draw(
    names: Names = None, out: Out = OUT, root: Root = Path(), workers: Workers = None, width: Width = 150.0
) -> None:
    """Draw again from the data that are there, whatever code and settings they were computed with."""
    _make(names, out, root, [], workers, width, only_draw=True)


def _make(
    names: list[str] | None,
    out: Path,
    root: Path,
    changes: list[str],
    workers: int | None,
    width: float,
    force: bool = False,
    only_draw: bool = False,
) -> None:
    from dsfit.errors import InputError
    from dsfit.figures import catalogue
    from dsfit.figures.run import run_all

    try:
        if changes and not names:
            raise InputError("--set", changes[0], "the names of the experiments whose settings it changes")
        entries = [catalogue.find(root, name) for name in dict.fromkeys(names or catalogue.names(root))]
        for entry in entries:
            entry.settings(changes)
    except InputError as error:
        _fail(str(error), 2)
    console = Console(highlight=False, markup=False, stderr=True)
    options = {"workers": workers, "width_mm": width, "force": force, "only_draw": only_draw}
    try:
        made = run_all(entries, out, changes, say=lambda name, what: console.print(f"{name}: {what}"), **options)
    except KeyboardInterrupt:
        _fail(f"interrupted; the same command goes on from here: {out}", 130)
    except OSError as error:
        _fail(f"{out}: {error}", 1)
    for one in made:
        what = one.failure or ("computed" if one.computed else "drawn" if one.drawn else "up to date")
        print(f"{one.name:<28} {what}  {one.seconds:.1f} s")
    failed = [one.name for one in made if one.failure]
    if failed:
        _fail(f"{len(failed)} of {len(made)} failed: {', '.join(failed)}", 1)


def _fail(message: str, code: int) -> NoReturn:
    typer.echo(f"dsfit: {message}", err=True)
    raise typer.Exit(code)
