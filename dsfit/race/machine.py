"""What this machine can do: memory bandwidth, elementary functions, gathers and multiply-adds in float32, measured.

A kernel that moves b bytes, takes e exponentials, g gathers and m multiply-adds per direction cannot take less than the
largest of b / copy, e / exp, g / gather and m / multiply-add, and hardly more than their sum: that is its roofline
(Williams, Waterman and Patterson 2009). Rates hold for the number of threads that torch is set to.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field

import torch
from torch import Tensor

SIZES = {"L1": 4 << 10, "L2": 256 << 10, "memory": 32 << 20}
"""Float32 numbers in the buffers of each level: 16 KiB, 1 MiB, 128 MiB."""
TABLES = {"16 KiB": 4 << 10, "512 KiB": 128 << 10, "8 MiB": 2 << 20, "128 MiB": 32 << 20}
"""Float32 numbers in the tables that are gathered from."""
UNROLL = 16
"""How often a compiled loop applies its operation to a number that it has loaded, so that memory does not matter."""
LINE = 16
"""Float32 numbers in a cache line."""

_EAGER: dict[str, Callable[..., Tensor]] = {
    "exp": torch.exp,
    "log": torch.log,
    "sin": torch.sin,
    "asin": torch.asin,
    "erf": torch.erf,
    "sqrt": torch.sqrt,
    "multiply": lambda x, out: torch.mul(x, 1.01, out=out),
}


@dataclass
class Machine:
    """Rates per second, of all threads together.

    Attributes:
        threads: threads that torch was set to.
        copy: bytes read and written by a copy, by level of memory.
        eager: float32 numbers through one torch operation, buffers in L2.
        compiled: float32 operations in a compiled loop that keeps them in registers; empty without a compiler.
        gather: numbers gathered at random places, by size of the table: by torch ("eager"), in a compiled loop; and
            whole cache lines of 16 numbers ("lines"), by torch.
        matrix: multiply-adds of a large matrix product.
        note: why nothing was compiled, if so.
    """

    threads: int
    copy: dict[str, float] = field(default_factory=dict)
    eager: dict[str, float] = field(default_factory=dict)
    compiled: dict[str, float] = field(default_factory=dict)
    gather: dict[str, dict[str, float]] = field(default_factory=dict)
    matrix: float = 0.0
    note: str = ""


def probe(seconds: float = 0.1, *, compiled: bool = True, tables: dict[str, int] | None = None) -> Machine:
    """Measure this machine; `seconds` for each rate, without the time that compiling takes.

    Rates are those of the fastest repetition: what the machine can do, not what others left of it.
    """
    machine = Machine(torch.get_num_threads())
    sizes = TABLES if tables is None else tables
    with torch.no_grad():
        for level, size in SIZES.items():
            source, target = torch.ones(size), torch.ones(size)
            machine.copy[level] = 8 * size * _rate(lambda a=source, b=target: b.copy_(a), seconds)
        x = torch.rand(SIZES["L2"]) * 0.9 + 0.05
        out = torch.empty_like(x)
        for name, function in _EAGER.items():
            machine.eager[name] = len(x) * _rate(lambda f=function: f(x, out=out), seconds)
        square = torch.rand(1024, 1024)
        product = torch.empty_like(square)
        machine.matrix = 1024**3 * _rate(lambda: torch.mm(square, square, out=product), seconds)
        machine.gather["eager"] = _gathers(lambda table, at: torch.index_select(table, 0, at), seconds, sizes)
        lines = {name: max(size // LINE, 2) for name, size in sizes.items()}
        machine.gather["lines"] = _gathers(lambda t, at: torch.index_select(t, 0, at), seconds, lines, LINE)
        if compiled:
            _compiled(machine, seconds, sizes)
    return machine


def _compiled(machine: Machine, seconds: float, tables: dict[str, int]) -> None:
    loops = {"exp": _exponentials, "multiply-add": _polynomial, "divide": _quotients}
    x = torch.rand(SIZES["L2"]) * 0.9 + 0.05  # fewer numbers and the call itself would count
    try:
        for name, function in loops.items():
            loop = torch.compile(function, dynamic=False)
            machine.compiled[name] = UNROLL * len(x) * _rate(lambda f=loop: f(x), seconds)
        take = torch.compile(lambda table, at: table[at] + 1.0, dynamic=True)
        machine.gather["compiled"] = _gathers(take, seconds, tables)
    except Exception as error:  # a missing compiler shows in many ways
        machine.note = f"nothing compiled: {type(error).__name__}"


def _exponentials(x: Tensor) -> Tensor:
    total = torch.exp(-x)
    for k in range(1, UNROLL):
        total = total + torch.exp(x * (0.1 * k))
    return total


def _quotients(x: Tensor) -> Tensor:
    total = 1 / x
    for k in range(1, UNROLL):
        total = total + k / (x + k)
    return total


def _polynomial(x: Tensor) -> Tensor:
    value = x
    for _ in range(UNROLL):
        value = value * x + 0.1
    return value


def _gathers(
    take: Callable[[Tensor, Tensor], Tensor], seconds: float, tables: dict[str, int], width: int = 1
) -> dict[str, float]:
    generator = torch.Generator().manual_seed(1)
    rates = {}
    for name, size in tables.items():
        table = torch.rand(*((size, width) if width > 1 else (size,)), generator=generator)
        at = torch.randint(size, (1 << 16 if width == 1 else 1 << 12,), generator=generator)
        rates[name] = len(at) * _rate(lambda t=table, i=at: take(t, i), seconds)
    return rates


def _rate(run: Callable[[], object], seconds: float) -> float:
    """Calls per second of the fastest of many slices of a millisecond or a call each."""
    run()
    start = time.perf_counter()
    run()
    repeats = max(1, int(1e-3 / max(time.perf_counter() - start, 1e-7)))
    best, begun = float("inf"), time.perf_counter()
    while best == float("inf") or time.perf_counter() - begun < seconds:
        start = time.perf_counter()
        for _ in range(repeats):
            run()
        best = min(best, (time.perf_counter() - start) / repeats)
    return 1 / best


__all__ = ["Machine", "probe"]
