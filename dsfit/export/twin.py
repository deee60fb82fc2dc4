"""The formulas of `dsfit.kernels` in float64 on the numbers of a header: what the header must agree with."""

from __future__ import annotations

import copy
import math

import numpy as np
import torch
from torch import Tensor

from dsfit.export.tables import Tables
from dsfit.kernels import HairKernel
from dsfit.kernels.contexts import mixture_fields
from dsfit.kernels.functions import plain_functions
from dsfit.kernels.hair import _Plain
from dsfit.kernels.tables import Grid, LawTables, refined
from dsfit.proposals.amortised import AmortisedProposal


class Twin:
    """eval, log_prob and sample at float64 contexts `[B]` and directions `[S, B]`, with a header's tables.

    Args:
        kernel: of the same BSDF and proposal; its formulas are taken, not its tables.
        tables: of the header.
    """

    def __init__(self, kernel: HairKernel, tables: Tables) -> None:
        own = copy.copy(kernel)
        own.backend, own._mode, own._programs = "eager", "eager", {}
        rows, columns = tables.trt.values.shape[:2]
        own.grid, own.columns = Grid(rows, columns), _columns(tables, columns)
        own.averages = torch.from_numpy(tables.averages)
        own.laws = _laws(tables, columns, kernel.laws.number)
        own.snapshot = _proposal(kernel.snapshot, tables)
        self.kernel, self.program = own, own.program("both")
        self.run = plain_functions(self.program.layout)
        self.sphere = torch.tensor(kernel.sphere, dtype=torch.float64)

    def fields(self, theta_r: Tensor, n: Tensor, v: Tensor) -> Tensor:
        """The mixtures of contexts, `[F, K, B]` in the order of `kernels.layout.FIELDS`."""
        shape = self.kernel.snapshot.shape(_Plain(theta_r, n, v))
        given = (shape.log_weights, shape.mode, shape.below, shape.above)
        return mixture_fields(theta_r, given, self.program.components)

    def eval(self, theta_r: Tensor, n: Tensor, v: Tensor, theta_i: Tensor, phi: Tensor) -> Tensor:
        """F cos(theta_i) `[S, B, C]`."""
        t = self._doubles()
        return self.run.eval(t[0], t[1], t[2], (theta_r, n, v), theta_i, phi).movedim(0, -1)

    def pdf(self, theta_r: Tensor, fields: Tensor, theta_i: Tensor, phi: Tensor) -> Tensor:
        """Density per steradian `[S, B]`."""
        return torch.exp(self.run.log_prob(self._doubles()[1], theta_r, (fields, self.sphere), theta_i, phi))

    def sample(self, theta_r: Tensor, fields: Tensor, u: Tensor) -> tuple[Tensor, Tensor]:
        """theta_i and phi `[S, B]` from uniforms `[S, B, 3]`."""
        laws = self.kernel.laws
        flat = (laws.density.flatten(), laws.cumulative.flatten(), None)
        return self.run.sample(theta_r, fields, flat, u)

    def _doubles(self) -> tuple[Tensor, ...]:
        t = self.program.tables
        return t.constants.double(), t.records.double(), t.averages.double()


def _columns(tables: Tables, columns: int) -> dict[str, Tensor]:
    """N_TRT and N^G on the whole grid."""
    values, scale = tables.spread.values.astype(np.int64), tables.spread.scale.astype(np.float64)
    mirrored = 2 * values[:, -1:] - values[:, -2::-1]
    whole = torch.from_numpy(np.concatenate([values, mirrored], axis=1) * scale[:, None])
    whole = refined(whole.movedim(-1, 0), len(scale), columns).movedim(0, -1)
    channels = tables.trt.values.shape[2]
    trt = torch.from_numpy(tables.trt.values * tables.trt.scale.astype(np.float64)[:, None])
    return {
        "TRT": trt,
        "R_scattered": whole[..., :1],
        "TT_scattered": whole[..., 1 : 1 + channels],
        "TRT_scattered": whole[..., 1 + channels :],
    }


def _laws(tables: Tables, columns: int, number: dict[int, int]) -> LawTables:
    """Laws of azimuth on one grid, and their CDFs."""
    scale = tables.law_scale().astype(np.float64)
    parts = [torch.from_numpy(law * s[:, None]) for law, s in zip(tables.laws, scale, strict=True)]
    rows = len(parts[0])
    density = torch.cat([refined(x[None], rows, columns) for x in parts])
    cells = (density[..., 1:] + density[..., :-1]) * (0.5 * math.pi / (columns - 1))
    cumulative = torch.cat([torch.zeros_like(density[..., :1]), cells.cumsum(-1)], dim=-1)
    return LawTables(Grid(rows, columns), density, cumulative / cumulative[..., -1:], number)


def _proposal(snapshot: AmortisedProposal, tables: Tables) -> AmortisedProposal:
    """The proposal with the moments of the header, in float64."""
    own = copy.deepcopy(snapshot).double()
    lobes = own.lobes
    lobes.direct = torch.from_numpy(tables.near).double()
    lobes.scattered = torch.from_numpy(tables.far()).double()
    lobes.depths = torch.from_numpy(tables.depths).double()
    return own
