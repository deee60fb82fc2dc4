"""Time that a kernel's operations take at the rates of the machine."""

from __future__ import annotations

from typing import Any


def bounds(machine: dict[str, Any], count: dict[str, float]) -> dict[str, float]:
    """Seconds per direction that each resource takes on one core, from what was counted and what was measured.

    Roots and quotients at the rate of divisions; everything else that is counted at the rate of multiply-adds;
    gathers from tables of 512 KiB; bytes of arguments and results from memory.
    """
    compiled, gather = machine["compiled"], machine["gather"].get("compiled", machine["gather"]["eager"])
    rate = {
        "transcendentals": compiled.get("exp", machine["eager"]["exp"]),
        "roots and quotients": compiled.get("divide", machine["eager"]["sqrt"]),
        "gathers": gather.get("512 KiB", max(gather.values())),
        "other": compiled.get("multiply-add", machine["eager"]["multiply"]),
        "least bytes": machine["copy"]["memory"],
        "multiply-adds of matrices": machine["matrix"],
    }
    return {name: count.get(name, 0.0) / speed for name, speed in rate.items()}
