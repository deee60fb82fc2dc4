"""What the caption and the text around the chapter's figure 1 claim, as numbers per fibre."""

from __future__ import annotations

import torch
from torch import Tensor

from dsfit.bsdf import Averages


def claims_of(
    theta: Tensor, found: Averages, outgoing: Averages, n: list[float], near: float
) -> dict[str, float | list[float]]:
    """Numbers that decide the claims, of means over channels unless said otherwise.

    Args:
        theta: inclinations in degrees, evenly spaced, 0 in the middle, +-90 at the ends.
        found: averages with the published cosine of incidence; `outgoing`: with the cosine of the outgoing light, whose
            sum is the share of the light that leaves.
        n: numbers of fibres, least and largest of which are compared.
        near: degrees that count as around 0.
    """
    a_f, a_b = found.a_f.mean(-1), found.a_b.mean(-1)
    share = a_b / (a_f + a_b)
    middle = len(theta) // 2
    grazing = int(torch.nonzero(theta >= 85 - 1e-9)[0])
    most = int(a_b.argmax())
    inside = theta.abs() <= near + 1e-9
    ends = [min(n), max(n)]
    return {
        "a_f_0": float(a_f[middle]),
        "a_b_0": float(a_b[middle]),
        "a_b_most": float(a_b[most]),
        "a_b_most_deg": float(theta[most]),
        "a_b_last": float(a_b[-2]),
        "a_b_last_deg": float(theta[-2]),
        "outgoing_a_b_0": float(outgoing.a_b.mean(-1)[middle]),
        "outgoing_a_b_grazing": float(outgoing.a_b.mean(-1)[grazing]),
        "back_share_0": float(share[middle]),
        "back_share_grazing": float(share[grazing]),
        "grazing_deg": float(theta[grazing]),
        "back_share_falls_by": max(_fall(share[middle:-1]), _fall(share[1 : middle + 1].flip(0))),
        "near_of_all": [_inside(a_f, k, inside, theta) for k in ends],
        "n": ends,
        "left_10": float(a_f.max() ** 10),
        "alpha_f_deg": [float(x) for x in torch.rad2deg(found.alpha_f[middle]).aminmax()],
        "back_share_channels": _range((found.a_b / (found.a_f + found.a_b))[middle]),
    }


def _fall(values: Tensor) -> float:
    """By how much values that should never fall, do: the largest drop from any earlier value."""
    return float((values.cummax(0).values - values).max())


def _inside(a_f: Tensor, n: float, inside: Tensor, theta: Tensor) -> float:
    """Share of int a_f^n dtheta that comes from inside."""
    law = torch.exp(n * torch.log((a_f / a_f.max()).clamp_min(1e-300)))
    at = theta[inside]
    part = torch.trapezoid(law[inside], at)
    return float(part / torch.trapezoid(law, theta))


def _range(values: Tensor) -> list[float]:
    return [float(values.min()), float(values.max())]


__all__ = ["claims_of"]
