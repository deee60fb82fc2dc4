"""Compiles a kernel's source for this machine and keeps what was built in a private folder of the user's cache."""

from __future__ import annotations

import ctypes
import hashlib
import os
import platform
import shutil
import stat
import subprocess
import tempfile
from pathlib import Path

_FLAGS = ("-std=gnu++17", "-O3", "-march=native", "-fno-math-errno", "-fno-trapping-math", "-ffp-contract=fast",
          "-Wno-psabi", "-shared", "-fPIC")  # fmt: skip


class NoCompiler(RuntimeError):
    """No C++ compiler that can build the kernel."""


def built(source: str) -> ctypes.CDLL:
    """The library of a source, compiled at first use. Processes that build it at the same time each do so in a folder
    of their own; the finished file is moved into place at once, so that none ever loads half of it.

    Raises:
        NoCompiler: there is no compiler, it fails, or there is nowhere to keep what it builds.
    """
    compiler = os.environ.get("CXX") or shutil.which("g++") or shutil.which("clang++")
    if not compiler:
        raise NoCompiler("no C++ compiler found (g++, clang++ or $CXX)")
    key = hashlib.sha256("\0".join([source, *_FLAGS, compiler, _machine()]).encode()).hexdigest()[:24]
    try:
        path = cache() / f"{key}.so"
        if not path.exists():
            _compile(compiler, source, path)
        return ctypes.CDLL(str(path))
    except OSError as error:
        raise NoCompiler(f"the compiled kernel cannot be kept or loaded: {error}") from None


def _compile(compiler: str, source: str, path: Path) -> None:
    with tempfile.TemporaryDirectory(dir=path.parent) as folder:
        text, made = Path(folder) / "kernel.cpp", Path(folder) / "kernel.so"
        text.write_text(source)
        command = [compiler, *_FLAGS, str(text), "-o", str(made)]
        try:
            done = subprocess.run(command, capture_output=True, text=True, check=False)
        except OSError as error:
            raise NoCompiler(f"{compiler}: {error}") from None
        if done.returncode:
            raise NoCompiler(f"{compiler} failed: {done.stderr.strip()[-500:]}")
        os.replace(made, path)


def _machine() -> str:
    """What -march=native depends on."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.platform() + platform.processor()
    return next((line for line in lines if line.startswith(("flags", "Features"))), "") + platform.machine()


def cache() -> Path:
    """A folder that only this user can write to: code is loaded from it. `$XDG_CACHE_HOME/dsfit/kernels`, or one among
    the temporary files where that is another user's or cannot be written.

    Raises:
        OSError: neither can be made private.
    """
    base = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    try:
        base.mkdir(parents=True, exist_ok=True)
        (base / "dsfit").mkdir(exist_ok=True)
        return _private(base / "dsfit" / "kernels")
    except OSError:
        return _private(Path(tempfile.gettempdir()) / f"dsfit-kernels-{_user()}")


def _private(folder: Path) -> Path:
    """The folder, made if need be; refused if it is a link, another user's or not writable. What others may write to is
    closed to them and emptied: its files may be theirs."""
    folder.mkdir(mode=0o700, exist_ok=True)
    found = folder.lstat()
    if not stat.S_ISDIR(found.st_mode) or found.st_uid != _user() or not os.access(folder, os.W_OK | os.X_OK):
        raise PermissionError(f"{folder} is not a folder of this user's own")
    if found.st_mode & 0o022:
        folder.chmod(0o700)
        for path in folder.glob("*.so"):
            path.unlink()
    return folder


def _user() -> int:
    return os.getuid() if hasattr(os, "getuid") else 0
