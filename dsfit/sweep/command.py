"""`dsfit sweep CONFIG`: all points of a config's `[sweep]`, on this machine or on a Dask cluster.

Exit codes: 0 done, 1 some cells failed or the sweep could not go on (what is done is kept), 2 the config or an argument
is wrong (nothing was written), 130 interrupted.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NoReturn

import typer

if TYPE_CHECKING:
    from dsfit.sweep.executors import Machines
    from dsfit.sweep.plan import Plan


def sweep(
    config: Annotated[Path, typer.Argument(help="TOML file with a [sweep], as configs/sweep_sobol_quick.toml.")],
    set_: Annotated[
        list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="Change one key; may be repeated.")
    ] = None,
    out: Annotated[Path | None, typer.Option(help="Folder for the sweep's directory, instead of output.dir.")] = None,
    workers: Annotated[
        int | None, typer.Option(min=1, help="Processes of this machine; default: the number of cores.")
    ] = None,
    dask: Annotated[
        str | None, typer.Option(metavar="ADDRESS", help="Dask scheduler instead: tcp://host:8786, or its JSON file.")
    ] = None,
    retries: Annotated[int, typer.Option(min=0, max=100, help="How often a cell that failed is tried again.")] = 1,
    timeout: Annotated[float | None, typer.Option(min=0.01, help="Seconds after which a cell is given up.")] = None,
    force: Annotated[bool, typer.Option("--force", help="Compute anew what an earlier sweep left.")] = False,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Only say what it would take; write nothing.")] = False,
    pilot: Annotated[int, typer.Option(min=0, max=1000, help="Cells that --dry-run times.")] = 3,
) -> None:
    """Compute every point of a design of config keys: one table, whatever failed apart, and an interrupted sweep goes
    on where it stopped."""
    from dsfit.errors import InputError
    from dsfit.experiment.rundir import RunFailure
    from dsfit.sweep.executors import DaskCluster, LocalProcesses
    from dsfit.sweep.plan import make_plan
    from dsfit.sweep.progress import SweepProgress
    from dsfit.sweep.run import run_sweep, sweep_directory

    def machines() -> Machines:
        from dsfit.experiment.runner import cores

        return LocalProcesses(workers or cores()) if dask is None else DaskCluster(dask)

    path = None
    try:
        if dask is not None and workers is not None:
            raise InputError("--workers", workers, "left out with --dask: all workers of the scheduler are used")
        with SweepProgress(config.stem) as progress:
            plan = make_plan(config, set_ or [], progress.validated)
            if dry_run:
                _estimate(plan, pilot, timeout, workers)
                return
            path = sweep_directory(plan, out)
            record = run_sweep(plan, path, machines, retries=retries, timeout=timeout, force=force, tell=progress)
    except InputError as error:
        _fail(f"config error\n{error}" if path is None else str(error), 2)
    except KeyboardInterrupt:
        _fail(f"interrupted; the same command goes on from here: {path or config}", 130)
    except (RunFailure, OSError) as error:
        _fail(f"sweep failed: {error}\nthe same command goes on from here: {path or config}", 1)
    _report(path, record)


def _report(path: Path, record: dict[str, Any]) -> None:
    counts, failures = record["counts"], record["failures"]
    print(f"{counts['done']} of {counts['cells']} cells, {counts['rows']} rows: {path / 'results.parquet'}")
    print(f"medians: {path / 'table.md'}")
    if counts["failed"]:
        for failure in failures[:5]:
            first = (failure["error"].splitlines() or [""])[0][:200]
            print(f"  cell {failure['cell']} {failure['fate']}: {first}\n    dsfit run {path / failure['config']}")
        _fail(f"{counts['failed']} of {counts['cells']} cells failed; {path / 'failures'}; the same command tries them "
              "again", 1)  # fmt: skip


def _estimate(plan: Plan, count: int, timeout: float | None, workers: int | None) -> None:
    from dsfit.experiment.runner import cores
    from dsfit.sweep.pilot import describe
    from dsfit.sweep.pilot import pilot as timed

    for line in describe(plan):
        print(line)
    if not count:
        return
    found = timed(plan, count, timeout)
    mean, most = found.cell_seconds
    at_once = workers or cores()
    print(f"{found.cells} cells timed: {mean:.3g} s each ({most:.3g} s the slowest)")
    for failure in found.failed:
        print(f"  failed: {failure}")
    print(f"all: {found.hours:.3g} CPU hours, {found.hours / at_once:.3g} h with {at_once} workers; {found.rows} rows; "
          f"files: cells.log {_size(found.log_bytes)}, results.parquet about {_size(found.table_bytes)}, 4 small ones"
          )  # fmt: skip


def _size(count: int) -> str:
    for unit, size in (("GB", 1e9), ("MB", 1e6), ("kB", 1e3)):
        if count >= size:
            return f"{count / size:.3g} {unit}"
    return f"{count} B"


def register(app: typer.Typer) -> None:
    """Add the command to the program."""
    app.command("sweep")(sweep)


def _fail(message: str, code: int) -> NoReturn:
    typer.echo(f"dsfit: {message}", err=True)
    raise typer.Exit(code)
