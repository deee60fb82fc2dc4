"""`dsfit report DIR`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def report(
    directory: Annotated[
        Path, typer.Argument(help="A run directory, or the output directory of `dsfit figures` or `dsfit sweep`.")
    ],
    out: Annotated[Path | None, typer.Option(help="The file; report.html in the directory if left out.")] = None,
    root: Annotated[Path, typer.Option(help="Folder that holds experiments/ and configs/.")] = Path(),
) -> None:
    """Write one self-contained HTML page about what a directory holds: what was asked, what came out, where from."""
    from dsfit.errors import InputError
    from dsfit.report.write import write_report

    try:
        typer.echo(f"report: {write_report(directory, out, root)}")
    except InputError as error:
        typer.echo(f"dsfit: {error}", err=True)
        raise typer.Exit(2) from None
    except OSError as error:
        typer.echo(f"dsfit: {error.filename or directory}: {error.strerror or error}", err=True)
        raise typer.Exit(1) from None
