"""Which implementation of the integrand all peers of a race use."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from dsfit.context import Context
from dsfit.errors import InputError
from dsfit.race.clock import timed
from dsfit.scene.integrand import Integrand


class Lit:
    """A compiled integrand under a constant light, with what an `Integrand` says about itself."""

    def __init__(self, compiled: Any, exact: Integrand) -> None:
        self.compiled, self.exact = compiled, exact
        self.radiance = exact.light.radiance.to(torch.float32)
        self.plain = bool((self.radiance == 1).all())

    def __getattr__(self, name: str) -> Any:
        return getattr(self.exact, name)

    def __call__(self, omega_i: Tensor, context: Context) -> Tensor:
        value = self.compiled(omega_i, context)
        return value if self.plain else value * self.radiance


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
    kernel, seconds = timed(lambda: HairKernel(exact.bsdf))
    backend = str(kernel.backend)
    if not backend.startswith("compiled"):
        if implementation == "compiled":
            raise InputError("race.implementation", implementation, f"'eager' (no compiled kernel: {backend})")
        return exact, {"implementation": "eager", "reason": backend}
    return Lit(kernel.integrand(), exact), {"implementation": "compiled", "reason": backend, "compile_seconds": seconds}
