"""What the lobes of three kinds of proposal are at a context, brought to the same groups: a best mix of the chapter's
proposals, a fitted structured mixture, and the amortised mixture."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch

from dsfit import Context

GROUPS = ("R", "TT", "TRT", "R_scattered", "TT_scattered", "TRT_scattered", "back", "broad")
_CHAPTER = {
    **{name: name for name in ("R", "TT", "TRT", "back")},
    **{f"M_{name}": name for name in ("R", "TT", "TRT")},
    **{f"MG_{name}": f"{name}_scattered" for name in ("R", "TT", "TRT")},
}


def group(name: str) -> int:
    """Index of the group that a component belongs to; what has no lobe of its own is broad."""
    name = name.removesuffix("_low").removesuffix("_high")
    known = name if name in GROUPS else _CHAPTER.get(name, "broad")
    return GROUPS.index(known)


def grouped(weights: Mapping[str, float]) -> np.ndarray:
    """Sums of weights by group `[8]`."""
    found = np.zeros(len(GROUPS))
    for name, weight in weights.items():
        found[group(name)] += weight
    return found


def fitted_weights(proposal: Any) -> np.ndarray:
    """Weights of a structured mixture by group, with the defensive share in the broad one."""
    weights = dict(zip(proposal.names, proposal.weights().detach().tolist(), strict=True))
    return grouped({**weights, "sphere": proposal.defensive})


def fitted_shapes(proposal: Any) -> np.ndarray:
    """Mode and widths below and above it (theta_h, degrees) by group `[8, 3]`; 0 where there is no such component."""
    found, values = np.zeros((len(GROUPS), 3)), proposal.constrained()
    for k, name in enumerate(proposal.names):
        for column, key in enumerate(("mode", "below", "above")):
            found[group(name), column] = math.degrees(float(values[f"components.{k}.longitudinal.{key}"][0].detach()))
    return found


def amortised_lobes(proposal: Any, contexts: Context) -> tuple[np.ndarray, np.ndarray]:
    """Weights `[B, 8]` and shapes `[B, 8, 3]` of the amortised proposal; of R's scattered lobe, which is three there,
    the shape of the middle one."""
    with torch.no_grad():
        shape = proposal.shape(contexts)
    log_weights = shape.log_weights.numpy()
    weights = np.zeros((len(contexts), len(GROUPS)))
    shapes = np.zeros((len(contexts), len(GROUPS), 3))
    columns = np.degrees(np.stack([shape.mode.numpy(), shape.below.numpy(), shape.above.numpy()], axis=-1))
    for k, name in enumerate(proposal.names):
        weights[:, group(name)] += np.exp(log_weights[:, k])
        if name in GROUPS:
            shapes[:, GROUPS.index(name)] = columns[:, k]
    weights[:, GROUPS.index("broad")] += proposal.defensive
    return weights, shapes


def mix_weights(names: Sequence[str], shares: Sequence[float]) -> np.ndarray:
    """Shares of the chapter's proposals by group."""
    return grouped(dict(zip(names, shares, strict=True)))
