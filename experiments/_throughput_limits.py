"""What binds a kernel: its counts per direction, and where its time goes by torch's profiler."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor
from torch.profiler import ProfilerActivity, profile

from dsfit.race.machine import LINE
from dsfit.streams import ContextStream
from experiments._throughput_counts import counted, least_bytes

_SAMPLES, _BATCH = 16, 256
_MOST = 8


def counts(library: Any) -> dict[str, dict[str, float]]:
    """Counts per direction (per context for `prepare`) of every task, from the eager kernel; the compiled one computes
    the same formulas. `least bytes` are those of the arguments, results and the context, each once."""
    kernel = library.kernels["kernel, eager"]
    found = {}
    for task, (run, inputs, directions) in _tasks(kernel).items():
        outputs = run()
        found[task] = counted(run, directions)
        results = outputs if isinstance(outputs, tuple) else (outputs,)
        tensors = tuple(x for x in results if isinstance(x, Tensor))
        found[task]["least bytes"] = least_bytes(inputs, tensors, directions) + _context_bytes(kernel, task)
        found[task]["lines"] = float(_lines(kernel, task))
    return found


def _context_bytes(kernel: Any, task: str) -> float:
    """Bytes of a prepared context that the task reads, for a direction with a context of its own: three numbers for the
    value, the whole mixture for densities and draws."""
    contexts = kernel.prepare(*(torch.tensor([x]) for x in (0.3, 2.0, 0.4)))
    mixture = 0 if task in ("eval", "prepare") else contexts.fields.numel()
    return 4.0 * (mixture + (0 if task == "prepare" else 3))


def _lines(kernel: Any, task: str) -> int:
    """Cache lines of tables that the compiled form reads per direction: records at the four corners of a cell, two
    rows of averages; what a bisection in a table of azimuths reads comes on top of that."""
    if task in ("prepare", "sample"):
        return 0
    layout = kernel.program("both").layout
    averages = 0 if task == "log_prob" else -(-5 * layout.channels // LINE)
    return 4 * (layout.width // LINE) + 2 * averages


def _tasks(kernel: Any) -> dict[str, tuple[Callable[[], Any], tuple[Tensor, ...], int]]:
    generator = torch.Generator().manual_seed(1)
    drawn = ContextStream().draw(_BATCH, generator)
    fields = tuple(x.float().contiguous() for x in (drawn.theta_r, drawn.n, drawn.v))
    u = torch.rand(_SAMPLES, _BATCH, 3, generator=generator).clamp(1e-6, 1 - 1e-6)
    with torch.no_grad():
        contexts = kernel.prepare(*fields)
        directions = tuple(x.contiguous() for x in kernel.sample(contexts, u))
    count = _SAMPLES * _BATCH
    return {
        "prepare": (lambda: kernel.prepare(*fields), fields, _BATCH),
        "eval": (lambda: kernel.eval(contexts, *directions), directions, count),
        "log_prob": (lambda: kernel.log_prob(contexts, *directions), directions, count),
        "sample": (lambda: kernel.sample(contexts, u), (u,), count),
        "fused": (lambda: kernel.sample_eval(contexts, u), (u,), count),
    }


def profiles(library: Any) -> dict[str, list[dict[str, Any]]]:
    """The operations with most time of their own, by kernel and task, as shares of the whole."""
    found = {}
    for name, kernel in library.kernels.items():
        for task, (run, _, _) in _tasks(kernel).items():
            if task in ("eval", "fused"):
                found[f"{name}, {task}"] = _profile(run)
    return found


def _profile(run: Callable[[], Any], calls: int = 20) -> list[dict[str, Any]]:
    with torch.no_grad():
        run()
        with profile(activities=[ProfilerActivity.CPU]) as recorded:
            for _ in range(calls):
                run()
    events = sorted(recorded.key_averages(), key=lambda event: -event.self_cpu_time_total)
    total = sum(event.self_cpu_time_total for event in events)
    return [
        {"name": event.key[:80], "share": event.self_cpu_time_total / total, "calls": event.count / calls}
        for event in events[:_MOST]
    ]
