"""Which implementation of the integrand all peers of a race use."""

from __future__ import annotations

from typing import Any

import torch

from dsfit.context import Context
from dsfit.errors import InputError
from dsfit.race.clock import children_seconds, timed
from dsfit.scene.integrand import Integrand

_SHAPES = ((1, 1), (16, 1), (1, 16), (16, 16))
"""Samples and contexts of the calls that a compiled integrand is compiled for."""


def make_integrand(exact: Integrand, implementation: str, dtype: torch.dtype) -> tuple[Any, dict[str, Any]]:
    """The integrand that peers call, and facts about it: `implementation`, `reason`, `compile_seconds`.

    Raises:
        InputError: "compiled" where no compiler works or the dtype is float64.
    """
    if implementation == "eager" or (implementation == "auto" and dtype != torch.float32):
        return exact, {"implementation": "eager", "reason": "asked for" if implementation == "eager" else "float64"}
    if dtype != torch.float32:
        raise InputError("race.implementation", implementation, "'eager' for float64")
    try:
        from dsfit.kernels import HairKernel
    except ImportError as error:
        if implementation == "compiled":
            raise InputError("race.implementation", implementation, f"'eager' ({error})") from None
        return exact, {"implementation": "eager", "reason": str(error)}
    kernel = HairKernel(exact.bsdf)
    integrand = kernel.integrand(exact.light)
    spent = children_seconds()
    _, seconds = timed(lambda: warm(integrand))
    backend = str(kernel.backend)
    if not backend.startswith("compiled"):
        if implementation == "compiled":
            raise InputError("race.implementation", implementation, f"'eager' (no compiled kernel: {backend})")
        return exact, {"implementation": "eager", "reason": backend}
    seconds += children_seconds() - spent
    return integrand, {"implementation": "compiled", "reason": backend, "compile_seconds": seconds}


def warm(integrand: Integrand) -> None:
    """Call the integrand once for lit, unlit and mixed contexts, and single and many of them and of their samples."""
    with torch.no_grad():
        for samples, contexts in _SHAPES:
            for v in (1.0, 0.0, 0.5) if contexts == 1 else (0.5,):
                n = torch.full((contexts,), 0.0 if v == 1 else 2.0)
                context = Context(torch.linspace(-0.3, 0.4, contexts), 0.0, n, torch.full_like(n, v))
                integrand(torch.rand(samples, contexts, 2) - 0.5, context)
