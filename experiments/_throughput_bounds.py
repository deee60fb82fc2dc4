"""Time that a kernel's operations take at the rates of the machine."""

from __future__ import annotations

from typing import Any


def bounds(machine: dict[str, Any], count: dict[str, float]) -> dict[str, float]:
    """Seconds per direction that each resource takes on one core, from what was counted and what was measured.

    Roots and quotients at the rate of divisions; everything else that is counted at the rate of multiply-adds;
    cache lines from tables of 8 MiB, or, where a kernel reads none, numbers gathered one by one; bytes of arguments and
    results from memory.
    """
    compiled, gather = machine["compiled"], machine["gather"]
    single, lines = gather.get("compiled", gather["eager"]), gather["lines"]
    looked_up = "lines" if count.get("lines") else "gathers"
    rate = {
        "transcendentals": compiled.get("exp", machine["eager"]["exp"]),
        "roots and quotients": compiled.get("divide", machine["eager"]["sqrt"]),
        looked_up: lines.get("8 MiB", max(lines.values())) if looked_up == "lines" else max(single.values()),
        "other": compiled.get("multiply-add", machine["eager"]["multiply"]),
        "least bytes": machine["copy"]["memory"],
        "multiply-adds of matrices": machine["matrix"],
    }
    times = {name: count.get(name, 0.0) / speed for name, speed in rate.items()}
    return {"look-ups" if name == looked_up else name: seconds for name, seconds in times.items()}
