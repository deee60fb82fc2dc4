"""Where a result came from: code, packages, machine, git state."""

from __future__ import annotations

import datetime
import hashlib
import importlib.metadata
import json
import os
import platform
import subprocess
import sys
from functools import cache
from pathlib import Path
from typing import Any

from dsfit.experiment.schema import Config

_PACKAGES = (
    "torch", "numpy", "scipy", "jax", "jaxlib", "optimistix", "OpenEXR", "embreex", "pydantic", "matplotlib", "emcee",
    "mpmath",
)  # fmt: skip


def version() -> str:
    """Version of the installed package; "0+source" when run from a tree that is not installed."""
    try:
        return importlib.metadata.version("dsfit")
    except importlib.metadata.PackageNotFoundError:
        return "0+source"


_SOURCES = (".py", ".cpp", ".h", ".hpp")


# what only shows numbers: a change there leaves every number as it was
_SHOWING = ("cli.py", "figures/", "report/", "sweep/", "experiment/plots/")


@cache
def sources_hash(packages: tuple[str, ...] = (), numbers: bool = False) -> str:
    """Hash of the sources of dsfit, or of these packages of it and the modules beside them; with `numbers`, without
    what only shows numbers."""
    root = Path(__file__).resolve().parents[1]
    digest = hashlib.sha256()
    for path in sorted(path for path in root.rglob("*") if path.suffix in _SOURCES):
        name = path.relative_to(root)
        if packages and len(name.parts) > 1 and name.parts[0] not in packages:
            continue
        if numbers and name.as_posix().startswith(_SHOWING):
            continue
        digest.update(name.as_posix().encode() + b"\0" + path.read_bytes() + b"\0")
    return digest.hexdigest()[:12]


def code_version() -> str:
    """Package version and a hash of all its sources."""
    return f"{version()}+{sources_hash()}"


def numbers_version() -> str:
    """Package version and a hash of the sources that decide numbers: any change there makes another run."""
    return f"{version()}+{sources_hash(numbers=True)}"


def run_id(config: Config) -> str:
    """Hash of everything that decides the numbers: the resolved config without where it is written, files it reads,
    and the code."""
    shown = {"exposure", "tone_map"}  # change a rendering's PNG, which any run makes anew
    unused = {"compare": True} if config.kind == "render" else {}
    data = config.model_dump(exclude={"output": True, "title": True, "render": shown, **unused})
    for part in (data["light"], *data["light"].get("lights", []), data["geometry"]):
        if path := part.get("path"):
            part["path"] = hashlib.sha256(Path(path).read_bytes()).hexdigest()
    if config.kind == "check":
        from dsfit.experiment.checking import files_of

        data["files"] = [hashlib.sha256(Path(path).read_bytes()).hexdigest() for path in files_of(config)]
    identity = json.dumps([data, numbers_version()], sort_keys=True)
    return hashlib.sha256(identity.encode()).hexdigest()[:12]


def now() -> str:
    """The present time, UTC, ISO 8601."""
    return datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")


def provenance() -> dict[str, Any]:
    """Versions, machine and git state, as plain data."""
    return {
        "dsfit": code_version(),
        "python": sys.version.split()[0],
        "packages": {name: _package_version(name) for name in _PACKAGES},
        "machine": {
            "system": f"{platform.system()} {platform.release()}",
            "processor": _processor(),
            "cores": os.cpu_count(),
        },
        "git": _git_state(),
    }


def _package_version(name: str) -> str | None:
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return None


def _processor() -> str:
    try:
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    except OSError:
        pass
    return platform.processor() or platform.machine()


def _git_state() -> dict[str, Any] | None:
    """Commit of the source tree and whether it has changes; None outside a git work tree."""
    root = Path(__file__).resolve().parents[2]

    def git(*arguments: str) -> str:
        done = subprocess.run(
            ["git", "-C", str(root), *arguments], capture_output=True, text=True, timeout=20, check=True
        )
        return done.stdout.strip()

    try:
        if Path(git("rev-parse", "--show-toplevel")).resolve() != root:
            return None
        return {
            "commit": git("rev-parse", "HEAD"),
            "changed": bool(git("status", "--porcelain", "--untracked-files=no")),
        }
    except (OSError, subprocess.SubprocessError):
        return None
