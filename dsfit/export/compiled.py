"""A header compiled into a library, for tests and timings."""

from __future__ import annotations

import ctypes
import os
import shutil
import subprocess
import tempfile
from pathlib import Path

import torch
from torch import Tensor

from dsfit.export.render import source
from dsfit.kernels.compiler import NoCompiler

STRICT = ("-std=c++17", "-Wall", "-Wextra", "-Werror", "-pedantic", "-Wshadow", "-Wconversion")
FAST = ("-std=c++17", "-O3", "-march=native")
_P, _N = ctypes.c_void_p, ctypes.c_int64


def find_compiler() -> str:
    """A C++ compiler: $CXX, g++ or clang++.

    Raises:
        NoCompiler: there is none.
    """
    found = os.environ.get("CXX") or shutil.which("g++") or shutil.which("clang++")
    if not found:
        raise NoCompiler("no C++ compiler found (g++, clang++ or $CXX)")
    return found


def run_compiler(arguments: list[str], compiler: str | None = None) -> None:
    """Run a C++ compiler.

    Raises:
        NoCompiler: there is none, or it fails.
    """
    command = [compiler or find_compiler(), *arguments]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        raise NoCompiler(f"{' '.join(command)} failed: {done.stderr.strip()[:2000]}")


class CompiledHeader:
    """The functions of a header on float32 tensors: contexts `[B]`, directions `[S, B]`, uniforms `[S, B, 3]`.

    Args:
        header: path of the header.
        namespace: its namespace.
        flags: of the compiler.

    Raises:
        NoCompiler: there is no compiler, or it fails.
    """

    def __init__(
        self, header: str | Path, namespace: str = "hair", flags: tuple[str, ...] = FAST, compiler: str | None = None
    ) -> None:
        with tempfile.TemporaryDirectory() as folder:
            text, made = Path(folder) / "shim.cpp", Path(folder) / "shim.so"
            text.write_text(source("shim.cpp"))
            names = [f'-DHEADER="{Path(header).resolve()}"', f"-DNAMESPACE={namespace}"]
            run_compiler([*flags, *names, "-shared", "-fPIC", str(text), "-o", str(made)], compiler)
            self._code = ctypes.CDLL(str(made))
        self._code.context_size.restype = _N
        for name, arguments in _ARGUMENTS.items():
            function = getattr(self._code, name)
            function.argtypes, function.restype = arguments, None
        self._size, self.channels = int(self._code.context_size()), int(self._code.channel_count())

    def prepare(self, theta_r: Tensor, n: Tensor, v: Tensor) -> Tensor:
        """Contexts, bytes `[B, size]`."""
        out = torch.empty(len(theta_r), self._size, dtype=torch.uint8)
        self._code.prepare(*_pointers(theta_r, n, v), len(theta_r), out.data_ptr())
        return out

    def eval(self, contexts: Tensor, theta_i: Tensor, phi: Tensor) -> Tensor:
        """F cos(theta_i) `[S, B, C]`."""
        out = theta_i.new_empty(*theta_i.shape, self.channels)
        self._code.eval(contexts.data_ptr(), len(contexts), len(theta_i), *_pointers(theta_i, phi), out.data_ptr())
        return out

    def pdf(self, contexts: Tensor, theta_i: Tensor, phi: Tensor) -> Tensor:
        """Density per steradian `[S, B]`."""
        out = torch.empty_like(theta_i)
        self._code.pdf(contexts.data_ptr(), len(contexts), len(theta_i), *_pointers(theta_i, phi), out.data_ptr())
        return out

    def sample(self, contexts: Tensor, u: Tensor) -> tuple[Tensor, ...]:
        """theta_i, phi, density `[S, B]` and F cos(theta_i) `[S, B, C]`."""
        out = self._outputs(u.shape[:2])
        self._code.sample(contexts.data_ptr(), len(contexts), len(u), *_pointers(u, *out))
        return out

    def shade(self, theta_r: Tensor, n: Tensor, v: Tensor, u: Tensor) -> tuple[Tensor, ...]:
        """The same for contexts that are met once, uniforms `[B, 3]`."""
        out = self._outputs(u.shape[:1])
        self._code.shade(*_pointers(theta_r, n, v), len(u), *_pointers(u, *out))
        return out

    def vectors(self, wo: Tensor, wi: Tensor, n: Tensor, v: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """F cos(theta_i), the same over |wi.z|, and the density, of pairs of unit vectors `[B, 3]`."""
        f, pbrt = (wo.new_empty(len(wo), self.channels) for _ in range(2))
        density = wo.new_empty(len(wo))
        self._code.vectors(*_pointers(wo, wi, n, v), len(wo), *_pointers(f, pbrt, density))
        return f, pbrt, density

    def sample_vectors(self, wo: Tensor, u: Tensor, n: Tensor, v: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """wi `[B, 3]`, density and F cos(theta_i) of one draw for each wo."""
        wi, density, f = torch.empty_like(wo), wo.new_empty(len(wo)), wo.new_empty(len(wo), self.channels)
        self._code.sample_vectors(*_pointers(wo, u, n, v), len(wo), *_pointers(wi, density, f))
        return wi, density, f

    def _outputs(self, shape: torch.Size) -> tuple[Tensor, ...]:
        return *(torch.empty(shape) for _ in range(3)), torch.empty(*shape, self.channels)


_ARGUMENTS = {
    "prepare": (_P, _P, _P, _N, _P),
    "eval": (_P, _N, _N, _P, _P, _P),
    "pdf": (_P, _N, _N, _P, _P, _P),
    "sample": (_P, _N, _N, _P, _P, _P, _P, _P),
    "shade": (_P, _P, _P, _N, _P, _P, _P, _P, _P),
    "vectors": (_P, _P, _P, _P, _N, _P, _P, _P),
    "sample_vectors": (_P, _P, _P, _P, _N, _P, _P, _P),
}


def _pointers(*tensors: Tensor) -> list[int]:
    """Addresses of contiguous float32 tensors."""
    for x in tensors:
        assert x.dtype == torch.float32 and x.is_contiguous()
    return [x.data_ptr() for x in tensors]
