"""Headers that several tests share, and contexts to try them at."""

from __future__ import annotations

import functools
import math
import tempfile
from pathlib import Path

import torch
from torch import Tensor

import dsfit
from dsfit.export.compiled import STRICT, CompiledHeader, find_compiler
from dsfit.export.tables import make_tables
from dsfit.export.twin import Twin
from dsfit.export.writer import header
from dsfit.fit.amortise import amortise
from dsfit.kernels import HairKernel
from dsfit.kernels.compiler import NoCompiler
from dsfit.proposals import AmortisedProposal
from tests.kernels import cases as kernels

FLAGS = (*STRICT, "-O1")
KINDS = ("untrained", "any", "trained")


@functools.cache
def has_compiler() -> bool:
    try:
        find_compiler()
    except NoCompiler:
        return False
    return True


@functools.cache
def proposal(preset: str = "blond", kind: str = "any") -> AmortisedProposal:
    """Its closed-form start; with a network that is not zero ("any"); or briefly trained."""
    if kind == "any":
        return kernels.mixture(preset)
    if kind == "untrained":
        return AmortisedProposal(kernels.bsdf(preset), (8,)).requires_grad_(False)
    return amortise(kernels.bsdf(preset), steps=300, inclinations=64).proposal


@functools.cache
def text(preset: str = "blond", kind: str = "any") -> str:
    return header(kernels.bsdf(preset), proposal(preset, kind))


@functools.cache
def folder() -> tempfile.TemporaryDirectory:
    return tempfile.TemporaryDirectory()


@functools.cache
def path(preset: str = "blond", kind: str = "any") -> Path:
    found = Path(folder().name) / f"{preset}_{kind}.h"
    found.write_text(text(preset, kind))
    return found


@functools.cache
def compiled(preset: str = "blond", kind: str = "any", flags: tuple[str, ...] = FLAGS) -> CompiledHeader:
    return CompiledHeader(path(preset, kind), flags=flags)


@functools.cache
def twin(preset: str = "blond", kind: str = "any") -> Twin:
    bsdf, own = kernels.bsdf(preset), proposal(preset, kind)
    kernel = kernels.kernel(preset) if kind == "any" else HairKernel(bsdf, own, mode="eager")
    return Twin(kernel, make_tables(bsdf, own))


def contexts() -> tuple[Tensor, Tensor, Tensor]:
    """theta_r, n, v, float32: every combination of inclinations up to grazing, depths, and lit shares."""
    end = math.radians(89.9)
    theta_r = torch.tensor([-end, -1.4, -0.9, -0.3, 0.0, 0.4, 1.1, 1.5, end])
    n, v = torch.tensor([0.0, 0.5, 3.0, 30.0, 300.0]), torch.tensor([0.0, 0.3, 1.0])
    return tuple(x.flatten().contiguous() for x in torch.meshgrid(theta_r, n, v, indexing="ij"))


def uniforms(*shape: int, seed: int = 3) -> Tensor:
    return torch.rand(*shape, 3, generator=torch.Generator().manual_seed(seed))


def unit_vectors(count: int, seed: int) -> Tensor:
    """Uniform over the sphere, float32 `[count, 3]`; the first along the fibre, the second nearly so."""
    x = torch.randn(count, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    x[0], x[1] = torch.tensor([1.0, 0.0, 0.0]), torch.tensor([-1.0, 1e-4, -2e-4])
    return (x / x.norm(dim=-1, keepdim=True)).float()


def fiber(**changes: object) -> dsfit.Fiber:
    return dsfit.Fiber.preset("blond", **changes)
