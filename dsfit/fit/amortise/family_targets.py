"""What a family's network is trained on, and judged by: the best densities of many fibres at many contexts."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor, nn

from dsfit.bsdf.dual_scattering import DualScattering
from dsfit.context import Context
from dsfit.fit.amortise.excess import excess_at
from dsfit.fit.amortise.targets import Targets, make_targets
from dsfit.fit.amortise.train import training_contexts
from dsfit.proposals.amortised import AmortisedProposal
from dsfit.proposals.family import NAMES, FamilyMember, FamilyProposal
from dsfit.proposals.quick_tables import QuickScattering
from dsfit.streams import ContextStream

_ORIENTATIONS = 4
_THETA_NODES, _AZIMUTH_NODES = 3, 5


@dataclass(frozen=True)
class FamilyTargets:
    """Targets of views (a fibre seen at an inclination, with M pairs (n, v)); `len()` of them.

    Attributes:
        targets: their grids, padded to one size.
        start: what the fibres' tables say there, `AmortisedProposal.start`, each `[views, M, ...]`.
        floor: least M/M* - 1 of any density that does not know the orientation of the section, `[views, M]`; 0 for
            round fibres.
        fiber: number of the fibre of each view, `[views]`.
        seconds: it took to make tables and targets.
    """

    targets: Targets
    start: tuple[Tensor, ...]
    floor: Tensor
    fiber: Tensor
    seconds: float

    def __len__(self) -> int:
        return len(self.fiber)

    def __getitem__(self, rows: Tensor | slice) -> FamilyTargets:
        start = tuple(x[rows] for x in self.start)
        return FamilyTargets(self.targets[rows], start, self.floor[rows], self.fiber[rows], self.seconds)

    def excess(self, network: nn.Module, defensive: float) -> Tensor:
        """Excess at every context by its quadrature, `[views, M]`; differentiable in the network's parameters.

        For an eccentric section it is that of the mean over its orientations.
        """
        found = excess_at(self.targets, _Started(self.start, network, defensive))
        return (1 + self.floor) * (1 + found) - 1


class _Started(AmortisedProposal):
    """A proposal whose tables have been read already."""

    def __init__(self, start: tuple[Tensor, ...], network: nn.Module, defensive: float) -> None:
        nn.Module.__init__(self)
        self.known, self.network, self.defensive, self.names = start, network, defensive, NAMES

    def start(self, context: Context) -> tuple[Tensor, ...]:  # type: ignore[override]
        return self.known


class _Oriented(QuickScattering):
    """An eccentric fibre at a fixed phi_h."""

    def __init__(self, bsdf: QuickScattering, phi_h: float) -> None:
        vars(self).update(vars(bsdf))
        self._phi_h = torch.tensor(phi_h, dtype=torch.float64)

    def azimuthal(self, *args: Any, **named: Any) -> Tensor:
        return super().azimuthal(*args, **{**named, "phi_h": self._phi_h})

    def azimuthal_scattered(self, *args: Any, **named: Any) -> Tensor:
        return super().azimuthal_scattered(*args, **{**named, "phi_h": self._phi_h})


@torch.no_grad()
def family_targets(
    proposal: FamilyProposal,
    fibers: Sequence[DualScattering],
    stream: ContextStream,
    inclinations: int,
    pairs: int,
    generator: torch.Generator,
    *,
    dtype: torch.dtype = torch.float32,
    progress: Callable[[int], None] | None = None,
) -> FamilyTargets:
    """Targets of `inclinations` views of every fibre with `pairs` pairs (n, v) each, all contexts different.

    The BSDF is evaluated with the tables of `QuickScattering`: N^G and the averages to some 1e-4 (TRT of eccentric
    sections to 1e-3 in the mean), so excesses below 1e-5 mean nothing.
    """
    began = time.perf_counter()
    context = training_contexts(stream, inclinations * len(fibers), pairs, generator)
    order = torch.randperm(len(context), generator=generator)  # Sobol's order is not to tell fibres apart
    parts, starts, floors = [], [], []
    for k, bsdf in enumerate(fibers):
        views = context[order[k * inclinations : (k + 1) * inclinations]]
        targets, start, floor = _of_fiber(proposal, bsdf, views, dtype)
        parts.append(targets)
        starts.append(start)
        floors.append(floor)
        if progress is not None:
            progress(k + 1)
    start_all = tuple(torch.cat(x).to(dtype) for x in zip(*starts, strict=True))
    number = torch.arange(len(fibers)).repeat_interleave(inclinations)
    spent = time.perf_counter() - began
    return FamilyTargets(_joined(parts), start_all, torch.cat(floors).to(dtype), number, spent)


def _of_fiber(
    proposal: FamilyProposal, bsdf: DualScattering, views: Context, dtype: torch.dtype
) -> tuple[Targets, tuple[Tensor, ...], Tensor]:
    quick = QuickScattering(bsdf)
    member = FamilyMember(quick, proposal.network, proposal.defensive)
    sizes = {"dtype": dtype, "theta_nodes": _THETA_NODES, "azimuth_nodes": _AZIMUTH_NODES}
    start = member.start(views.to(torch.float64))
    if bsdf.fiber.is_round:
        return make_targets(quick, member, views, **sizes), start, torch.zeros_like(views.n)
    angles = [(k + 0.5) * math.pi / (2 * _ORIENTATIONS) for k in range(_ORIENTATIONS)]
    turned = [make_targets(_Oriented(quick, angle), member, views, **sizes) for angle in angles]
    best = torch.sqrt(sum(x.target.double() ** 2 for x in turned) / _ORIENTATIONS)
    whole = (turned[0].weight.double()[..., None] * best).sum((1, 2))
    best = (best / whole[:, None, None]).to(dtype)
    return replace(turned[0], target=best), start, whole**2 - 1


def _joined(parts: list[Targets]) -> Targets:
    """All views, their grids padded by nodes of weight 0."""
    rows = max(x.weight.shape[1] for x in parts)
    columns = max(x.weight.shape[2] for x in parts)

    def padded(x: Tensor) -> Tensor:
        missing = rows - x.shape[1]
        if x.dim() == 2:
            return torch.cat([x, x[:, -1:].expand(-1, missing)], dim=1)
        new = x.new_zeros(len(x), rows, columns, *x.shape[3:])
        new[:, : x.shape[1], : x.shape[2]] = x
        return new

    fields = [torch.cat([padded(getattr(x, name)) for x in parts]) for name in ("theta", "weight", "target", "azimuth")]
    contexts = [torch.cat([getattr(x.context, name) for x in parts]) for name in ("theta_r", "phi_r", "n", "v")]
    return Targets(Context(*contexts), *fields)


__all__ = ["FamilyTargets", "family_targets"]
