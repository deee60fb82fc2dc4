"""A plan as text, from its plain data."""

from __future__ import annotations

from typing import Any


def table(data: dict[str, Any]) -> str:
    """Lines of text: what is kept, what is not, why, and the bound on the error."""
    bound = "exact" if data["bound"] == 0 else f"error at most {data['bound']:.1e} of the integral"
    lines = [f"plan for {data['contexts']}; tolerance {data['tolerance']:g}: {bound}"]
    kept = [f"{half} {', '.join(names)}" for half, names in data["kept"].items() if names]
    lines.append(f"  kept     {'; '.join(kept) or 'nothing: the integral is 0'}")
    extras = [text for text, flag in _flags(data) if flag]
    if extras:
        lines.append(f"           {'; '.join(extras)}")
    for (halves, reason, bound_of), names in _grouped(data["dropped"]).items():
        error = "exact" if bound_of == 0 else f"{bound_of:.1e}"
        what = f"{halves} {', '.join(names)}"
        lines.append(f"  dropped  {what:<32} {error:<8} {reason}")
    if data["limits"]:
        lines.append(f"  exact zeros only: {data['limits']}")
    return "\n".join(lines)


def _flags(data: dict[str, Any]) -> list[tuple[str, bool]]:
    return [
        ("one channel stands for all (grey)", data["grey"]),
        ("even in azimuth: half the quadrature nodes", data["even"]),
        ("raw TRT: its caustic is not treated", not data["glint"] and any("TRT" in x for x in data["kept"].values())),
    ]


def _grouped(dropped: list[dict[str, Any]]) -> dict[tuple[str, str, float], list[str]]:
    groups: dict[tuple[str, str, float], list[str]] = {}
    for one in dropped:
        groups.setdefault((one["half"], one["reason"], one["bound"]), []).append(one["term"])
    return groups
