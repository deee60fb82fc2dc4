"""dsfit as contenders: the public path in float64, and `HairKernel` in float32, eager and compiled."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

import dsfit
from dsfit.bsdf.terms import Terms
from dsfit.context import Context
from dsfit.frame import to_angles
from dsfit.kernels import HairKernel
from dsfit.proposals.amortised import AmortisedProposal
from dsfit.streams import ContextStream
from experiments._throughput_timing import Contender

SHARED = 16
"""Samples of a context in the layout where contexts are shared."""
LAYOUTS = {"all different": 1, f"{SHARED} a context": SHARED}
MOST = {"float64": 10_000, "kernel, eager": 100_000, "contexts": 30_000}
"""Directions that the slower ones are timed with at most, and contexts that are prepared at once: more take seconds a
call and change no rate."""
PARTS = {"eval, direct only": Terms(scattered=()), "eval, scattered only": Terms(direct=())}
"""The kernels of some terms, for the cost of each."""


class Library:
    """BSDF, proposals and kernels of one fibre, made once."""

    def __init__(self, modes: tuple[str, ...], parts: bool) -> None:
        self.bsdf = dsfit.DualScattering(dsfit.Fiber.preset("blond"), precision="table")
        self.integrand = dsfit.Integrand(self.bsdf)
        self.structured = dsfit.StructuredProposal(self.bsdf, dsfit.Context(0.3, 0.0, 2.0, 0.4))
        self.amortised = AmortisedProposal(self.bsdf)
        self.kernels = {f"kernel, {mode}": HairKernel(self.bsdf, self.amortised, mode=mode) for mode in modes}
        fastest = modes[-1]
        self.parts = {name: HairKernel(self.bsdf, terms=terms, mode=fastest) for name, terms in PARTS.items() if parts}
        self.fastest = f"kernel, {fastest}"

    def contenders(self, count: int, layout: str, seed: int = 1) -> list[Contender]:
        """Every task that is timed for `count` directions in this layout."""
        work = _Work(count, LAYOUTS[layout], seed)
        found = []
        for name, kernel in self.kernels.items():
            if count <= MOST.get(name, count):
                found += _of_kernel(name, kernel, work, layout)
        if layout == "all different":
            for task, kernel in self.parts.items():
                run = _bound(kernel.eval, kernel.prepare(*work.single), work.theta_i, work.phi)
                found.append(Contender(self.fastest, task, layout, work.count, run))
            vector = torch.nn.functional.normalize(torch.randn(count, 3, generator=work.generator), dim=-1)
            found.append(Contender("torch", "to_angles", layout, count, _bound(to_angles, vector)))
        if count <= MOST["float64"]:
            found += self._float64(work, layout)
        return found

    def _float64(self, work: _Work, layout: str) -> list[Contender]:
        context, u, omega = work.context, work.u.double(), work.omega
        one, flat = Context(0.3, 0.0, 2.0, 0.4), u.reshape(-1, u.shape[-1])

        def amortised() -> None:
            drawn, _ = self.amortised(context).sample_with_log_prob(u)
            self.integrand(drawn, context)

        def structured() -> None:
            drawn, _ = self.structured(one).sample_with_log_prob(flat)
            self.integrand(drawn, one)

        runs: dict[tuple[str, str, str], Callable[[], object]] = {
            ("float64", "eval", layout): lambda: self.integrand(omega, context),
            ("float64", "log_prob", layout): lambda: self.amortised(context).log_prob(omega),
            ("float64", "sample", layout): lambda: self.amortised(context).sample(u),
            ("float64", "fused", layout): amortised,
        }
        if layout == "all different":
            runs["float64, StructuredProposal", "fused", "one context"] = structured
        return [Contender(*key, work.count, _without_grad(run)) for key, run in runs.items()]


class _Work:
    """Contexts as a renderer meets them, directions uniform over the sphere, and uniforms."""

    def __init__(self, count: int, samples: int, seed: int) -> None:
        batch = max(1, count // samples)
        self.count, self.shape = samples * batch, (samples, batch)
        self.generator = torch.Generator().manual_seed(seed)
        self.context = ContextStream().draw(batch, self.generator)
        self.single = tuple(x.float().contiguous() for x in (self.context.theta_r, self.context.n, self.context.v))
        self.theta_i = torch.asin(2 * self._uniform() - 1)
        self.phi = math.pi * (2 * self._uniform() - 1)
        self.u = self._uniform(3)
        self.omega = torch.stack([self.theta_i, -self.phi], dim=-1).double()

    def _uniform(self, *tail: int) -> Tensor:
        return torch.rand(*self.shape, *tail, generator=self.generator).clamp(1e-6, 1 - 1e-6)


def _of_kernel(name: str, kernel: HairKernel, work: _Work, layout: str) -> list[Contender]:
    contexts = kernel.prepare(*work.single)
    directions, u = (work.theta_i, work.phi), work.u
    runs = {
        "prepare": _bound(kernel.prepare, *work.single),
        "eval": _bound(kernel.eval, contexts, *directions),
        "log_prob": _bound(kernel.log_prob, contexts, *directions),
        "sample": _bound(kernel.sample, contexts, u),
        "fused": _bound(kernel.sample_eval, contexts, u),
        "prepare + eval": lambda: kernel.eval(kernel.prepare(*work.single), *directions),
        "prepare + fused": lambda: kernel.sample_eval(kernel.prepare(*work.single), u),
    }
    found = []
    for task, run in runs.items():
        if not task.startswith("prepare") or work.shape[1] <= MOST["contexts"]:
            count = work.shape[1] if task == "prepare" else work.count
            found.append(Contender(name, task, layout, count, _without_grad(run)))
    return found


def _bound(function: Callable[..., Any], *arguments: Any) -> Callable[[], object]:
    return _without_grad(lambda: function(*arguments))


def _without_grad(function: Callable[[], object]) -> Callable[[], object]:
    def run() -> object:
        with torch.no_grad():
            return function()

    return run
