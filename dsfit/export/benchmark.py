"""What a header's functions cost, beside the compiled kernel of `dsfit.kernels`, in turns on one core."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

import torch

from dsfit.bsdf.dual_scattering import DualScattering
from dsfit.export.compiled import FAST, CompiledHeader
from dsfit.kernels import HairKernel
from dsfit.proposals.amortised import AmortisedProposal
from dsfit.streams import ContextStream

_CONTEXTS, _SAMPLES = 2048, 8
_FLAGS = {
    "-O2": ("-std=c++17", "-O2"),
    "-O3 -march=native": FAST,
    "-O3 -march=native -ffast-math": (*FAST, "-ffast-math"),
}


def benchmark(
    path: str | Path,
    namespace: str,
    bsdf: DualScattering,
    proposal: AmortisedProposal,
    rounds: int = 31,
    seed: int = 1,
) -> dict[str, dict[str, float]]:
    """Nanoseconds of each operation, the least of `rounds` in turns: `{operation: {who: ns}}`.

    "prepare" is per context; "eval", "sample + pdf + eval" per direction (8 for each of 2048 prepared contexts);
    "shade" prepares a context and draws one sample. Contexts are as a renderer meets them: views uniform over the
    sphere, n exponential with mean 8, v = e^-n.

    Raises:
        NoCompiler: there is no C++ compiler.
        InputError: the kernel cannot be compiled.
    """
    kernel = HairKernel(bsdf, proposal, mode="compiled")
    generator = torch.Generator().manual_seed(seed)
    stream = ContextStream(theta="sphere", rule="poisson", n_mean=8.0).draw(_CONTEXTS, generator).to(torch.float32)
    given = (stream.theta_r.contiguous(), stream.n.contiguous(), stream.v.contiguous())
    u = torch.rand(_SAMPLES, _CONTEXTS, 3, generator=generator)
    once = u[:1].contiguous()
    ready = kernel.prepare(*given)
    theta_i, phi = kernel.sample(ready, u)
    runs: dict[str, dict[str, Callable[[], object]]] = {
        "prepare": {"kernel": lambda: kernel.prepare(*given)},
        "eval": {"kernel": lambda: kernel.eval(ready, theta_i, phi)},
        "sample + pdf + eval": {"kernel": lambda: kernel.sample_eval(ready, u)},
        "shade": {"kernel": lambda: kernel.shade(*given, once)},
    }
    for who, flags in _FLAGS.items():
        code = CompiledHeader(path, namespace, flags)
        own = code.prepare(*given)
        runs["prepare"][who] = lambda code=code: code.prepare(*given)
        runs["eval"][who] = lambda code=code, own=own: code.eval(own, theta_i, phi)
        runs["sample + pdf + eval"][who] = lambda code=code, own=own: code.sample(own, u)
        runs["shade"][who] = lambda code=code: code.shade(*given, once[0])
    least = {name: dict.fromkeys(of, float("inf")) for name, of in runs.items()}
    for _ in range(rounds):
        for name, of in runs.items():
            for who, call in of.items():
                began = time.perf_counter_ns()
                call()
                least[name][who] = min(least[name][who], time.perf_counter_ns() - began)
    for name, of in least.items():
        count = _CONTEXTS if name in ("prepare", "shade") else _CONTEXTS * _SAMPLES
        least[name] = {who: ns / count for who, ns in of.items()}
    return least


def table(found: dict[str, dict[str, float]]) -> str:
    """The benchmark as text: nanoseconds, and how often the kernel's time."""
    lines = ["nanoseconds on one core, least of many rounds in turns (times that of the compiled kernel)"]
    for name, of in found.items():
        parts = [f"{who} {ns:.0f} ({ns / of['kernel']:.1f}x)" for who, ns in of.items()]
        lines.append(f"{name + ':':<20} " + ", ".join(parts))
    return "\n".join(lines)
