"""The command line: `dsfit run CONFIG`, `dsfit check CONFIG`, `dsfit bench CONFIG`, `dsfit render CONFIG`,
`dsfit compare-images A.exr REF.exr`, `dsfit plan CONFIG`, `dsfit export CONFIG`, `dsfit show RUNDIR`, `dsfit presets`,
`dsfit figures list|run|draw`, `dsfit sweep CONFIG`, `dsfit report DIR`.

Exit codes: 0 done, 1 the run failed (what is done is kept), 2 the config or an argument is wrong (nothing was
written), 3 a check was not passed, 130 interrupted.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NoReturn

import typer
from rich.console import Console

from dsfit.figures.command import app as figures
from dsfit.report.command import report
from dsfit.sweep.command import register as register_sweep

if TYPE_CHECKING:
    from dsfit.experiment.rundir import RunDirectory

app = typer.Typer(
    help="Monte Carlo rendering of hair that converges faster: run experiments from config files.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)
app.add_typer(figures, name="figures")
app.command()(report)
register_sweep(app)


@app.callback()
def _group() -> None:
    pass  # makes `run` a subcommand whatever else there is


Config = Annotated[Path, typer.Argument(help="TOML file; configs/quickstart.toml is a good start.")]
Changes = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="KEY=VALUE", help="Change one key, as in --set fiber.eta=1.6; may be repeated."),
]
Out = Annotated[Path | None, typer.Option(help="Folder for run directories, instead of output.dir.")]
Force = Annotated[bool, typer.Option("--force", help="Compute anew what an earlier run left.")]
Workers = Annotated[
    int | None, typer.Option(min=0, help="Processes; default: the number of cores, 1 for a race. 0: none but this one.")
]


@app.command()
def run(config: Config, set_: Changes = None, out: Out = None, force: Force = False, workers: Workers = None) -> None:
    """Run an experiment: compute, tabulate, plot. A finished run is shown again, an interrupted one goes on where it
    stopped."""
    _run(config, set_ or [], out, force, workers)


@app.command()
def check(
    config: Config,
    suite: Annotated[
        list[str] | None, typer.Option(help="Run this suite instead of those of [check]; may be repeated.")
    ] = None,
    set_: Changes = None,
    out: Out = None,
    force: Force = False,
    workers: Workers = None,
) -> None:
    """Check the scene, the proposals and the library: the suites that the config's [check] names, or the usual ones.
    Exits with 3 if a check is not passed."""
    changes = [*(set_ or []), 'kind="check"']
    if suite:
        changes.append("check.suites=[" + ", ".join(f'"{name}"' for name in suite) + "]")
    result = _run(config, changes, out, force, workers)
    if result["report"]["verdict"] != "pass":
        raise typer.Exit(3)


@app.command()
def bench(config: Config, set_: Changes = None, out: Out = None, force: Force = False, workers: Workers = None) -> None:
    """Race peers: error against run time over a stream of contexts and at single ones, as the config's [race] says.
    Exits with 3 if a peer's estimates are off the truth."""
    from dsfit.experiment.race import failed

    result = _run(config, [*(set_ or []), 'kind="race"'], out, force, workers)
    if failed(result):
        raise typer.Exit(3)


@app.command()
def render(
    config: Config, set_: Changes = None, out: Out = None, force: Force = False, workers: Workers = None
) -> None:
    """Render a picture of hair, as the config's [geometry], [camera] and [render] say: EXR with variance, scatter
    counts and times, PNG, and what it took. An interrupted rendering goes on with the tiles that are missing."""
    _run(config, [*(set_ or []), 'kind="render"'], out, force, workers)


@app.command("compare-images")
def compare_images(
    image: Annotated[Path, typer.Argument(help="EXR image to be judged.")],
    reference: Annotated[Path, typer.Argument(help="EXR image to judge it by, of the same size and channels.")],
    out: Annotated[Path | None, typer.Option(help="Folder for the error maps, instead of the image's.")] = None,
) -> None:
    """Compare an image with a reference: RMSE, relative MSE and FLIP, what of them is the reference's own noise, and
    maps of the errors."""
    from dsfit.errors import InputError
    from dsfit.experiment.compare_images import compare_files, table

    try:
        found = compare_files(image, reference, out)
    except InputError as error:
        _fail(str(error), 2)
    except OSError as error:
        _fail(f"{error.filename}: {error.strerror}", 1)
    _console().print(table(found))
    _console().print(f"error maps: {found.picture}", soft_wrap=True)


def _run(config: Path, changes: list[str], out: Path | None, force: bool, workers: int | None) -> dict[str, Any]:
    """Run, report, and return the result; exits with 1, 2 or 130 where that cannot be done."""
    from dsfit.errors import InputError
    from dsfit.experiment import runner
    from dsfit.experiment.progress import BarProgress
    from dsfit.experiment.rundir import RunFailure
    from dsfit.experiment.validation import load

    try:
        experiment = load(config, changes)
    except InputError as error:
        _fail(f"config error\n{error}", 2)
    directory = runner.run_directory(experiment, out)
    try:
        with BarProgress(experiment.name) as progress:
            outcome = runner.run(experiment, out, force=force, workers=workers, progress=progress)
        if outcome.skipped:
            _console().print(f"already done; --force computes it anew: {directory.path}", soft_wrap=True)
        _report(directory, outcome.result, draw=experiment.config.output.plots and not outcome.skipped)
    except KeyboardInterrupt:
        _fail(f"interrupted; the same command goes on from here: {directory.path}", 130)
    except (RunFailure, InputError, OSError) as error:
        _fail(f"run failed: {error}\nthe same command goes on from here: {directory.path}", 1)
    return outcome.result


@app.command()
def plan(config: Config, set_: Changes = None) -> None:
    """Print what the config's contexts do not need: what is left out, why, and the proven bound on the error. `--set
    plan.tolerance=1e-3` allows for more than exact zeros."""
    from dsfit.errors import InputError
    from dsfit.experiment.planning import plans
    from dsfit.experiment.validation import load

    try:
        for heading, found in plans(load(config, set_ or [])):
            _console().print(f"{heading}: {found}", soft_wrap=True)
    except InputError as error:
        _fail(f"config error\n{error}", 2)


@app.command()
def export(
    source: Annotated[Path, typer.Argument(help="TOML file, or a proposal that dsfit.save_proposal wrote (.npz).")],
    out: Annotated[Path, typer.Option("--out", "-o", help="The header that is written.")] = Path("hair.h"),
    set_: Changes = None,
    proposal: Annotated[
        Path | None, typer.Option(help="Take this saved proposal of the config's fibre instead of training one.")
    ] = None,
    steps: Annotated[
        int | None, typer.Option(min=0, help="Steps of training, instead of [amortise]; 0: the closed-form start.")
    ] = None,
    namespace: Annotated[str, typer.Option(help="C++ namespace of the header.")] = "hair",
    example: Annotated[
        Path | None, typer.Option(help="Also write a program that integrates the sampler to known albedos.")
    ] = None,
    benchmark: Annotated[
        bool, typer.Option("--benchmark", help="Time the header beside the compiled kernel; needs a C++ compiler.")
    ] = False,
) -> None:
    """Write the fitted sampler and its BSDF as one C++ header without dependencies."""
    from dsfit.errors import InputError
    from dsfit.export import command

    try:
        for line in command.export(source, out, set_ or [], proposal, steps, namespace, example, benchmark):
            _console().print(line, soft_wrap=True)
    except InputError as error:
        _fail(str(error), 2)
    except (OSError, RuntimeError) as error:
        _fail(f"export failed: {error}", 1)


@app.command()
def show(
    rundir: Annotated[Path, typer.Argument(help="A run directory.")],
    plots: Annotated[
        bool, typer.Option("--plots/--no-plots", help="Draw the figures again from the stored data.")
    ] = False,
) -> None:
    """Print a finished run's table again, and draw its figures again if asked to."""
    from rich.errors import ConsoleError

    from dsfit.errors import InputError
    from dsfit.experiment.rundir import RunDirectory

    try:
        directory = RunDirectory(rundir)
        _report(directory, directory.result(), draw=plots)
    except OSError as error:
        _fail(f"{rundir}: {error}", 1)
    except (InputError, LookupError, TypeError, ValueError, AttributeError, ArithmeticError, ConsoleError) as error:
        text = (
            str(error)
            if isinstance(error, InputError)
            else f"{rundir}: damaged result ({type(error).__name__}: {error})"
        )
        _fail(text, 2)


@app.command()
def presets() -> None:
    """List the fibre presets."""
    from dsfit.bsdf import Fiber

    for name in Fiber.presets():
        sigma = ", ".join(f"{value:g}" for value in Fiber.preset(name).sigma_a.tolist())
        _console().print(f"{name:<14} sigma_a = [{sigma}] per fibre radius")


def _console() -> Console:
    """Standard output; as wide as the table needs where it is not a terminal."""
    # names and paths are shown as they are, whatever is in brackets
    plain = {"highlight": False, "markup": False, "emoji": False}
    return Console(**plain) if sys.stdout.isatty() else Console(**plain, width=170)


def _report(directory: RunDirectory, result: dict[str, Any], draw: bool) -> None:
    from dsfit.experiment import files, summary
    from dsfit.report import write_report

    console = _console()
    console.print(summary.terminal_table(result))
    files.write_bytes(directory.path / "table.md", summary.markdown(result).encode())
    figures = directory.path / "figures"
    if draw:
        from dsfit.experiment import plots

        plots.draw_all(directory, result)
        write_report(directory.path)
    console.print(f"results:   {directory.path / 'result.json'}", soft_wrap=True)
    if (image := directory.path / "image.exr").is_file():
        console.print(f"image:     {image}, image.png", soft_wrap=True)
    if (fitted := directory.path / "proposals").is_dir():
        console.print(f"proposals: {fitted} (dsfit.load_proposal)", soft_wrap=True)
    if figures.is_dir():
        console.print(f"figures:   {figures}", soft_wrap=True)
    if draw:
        console.print(f"report:    {directory.path / 'report.html'}", soft_wrap=True)


def _fail(message: str, code: int) -> NoReturn:
    typer.echo(f"dsfit: {message}", err=True)
    raise typer.Exit(code)


def main() -> None:
    """Entry point of the `dsfit` command."""
    app()


if __name__ == "__main__":
    main()
