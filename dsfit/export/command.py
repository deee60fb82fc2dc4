"""`dsfit export`: what it does, told line by line."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from dsfit.errors import InputError
from dsfit.export.render import check_namespace
from dsfit.export.sources import from_config, from_proposal
from dsfit.export.writer import write_example, write_header


def export(
    source: Path,
    out: Path,
    changes: list[str],
    proposal: Path | None,
    steps: int | None,
    namespace: str,
    example: Path | None,
    benchmark: bool,
) -> Iterator[str]:
    """Write the header (and the example), and say what was written.

    Raises:
        InputError: something in the config or the arguments is wrong, or a header cannot hold it; nothing is written.
        OSError, RuntimeError: a file cannot be written, or there is no compiler to time the header with.
    """
    check_namespace(namespace)
    if source.suffix == ".npz":
        for name, value in (("--set", changes), ("--proposal", proposal), ("--steps", steps)):
            if value:
                raise InputError(name, value, "a config as the source")
        bsdf, found, facts = from_proposal(source)
    else:
        bsdf, found, facts = from_config(source, changes, proposal, steps)
    written = write_header(out, bsdf, found, namespace=namespace, facts=facts)
    yield f"header:  {written.path}, {written.bytes / 1e6:.2f} MB, SHA-256 {written.sha256[:16]}"
    if example is not None:
        write_example(example, out, namespace)
        yield f"example: {example} (g++ -std=c++17 -O3 -march=native -I {out.parent} {example})"
    if benchmark:
        from dsfit.export.benchmark import benchmark as timed
        from dsfit.export.benchmark import table

        yield from table(timed(out, namespace, bsdf, found)).splitlines()
