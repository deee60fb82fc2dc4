"""A kernel for one half or both halves of the integrand: its tensors, and calls on prepared contexts."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from dsfit.errors import InputError
from dsfit.kernels.contexts import Contexts
from dsfit.kernels.functions import Functions, Tables, functions
from dsfit.kernels.layout import Layout
from dsfit.kernels.tables import refined
from dsfit.proposals.conditional import FiberAzimuth
from dsfit.proposals.lobe_moments import DIRECT, SCATTERED
from dsfit.proposals.uniform import BackHalf

if TYPE_CHECKING:
    from dsfit.kernels.hair import HairKernel

_FEW = 32


class Program:
    """eval, log_prob, sample and sample_eval for contexts that need the same half.

    Attributes:
        layout: what is computed.
        tables: what is read.
        components: numbers of the proposal's components that these contexts use.
    """

    def __init__(self, layout: Layout, tables: Tables, components: list[int], run: Functions) -> None:
        self.layout, self.tables, self.components, self.run = layout, tables, components, run

    def eval(self, contexts: Contexts, theta_i: Tensor, phi: Tensor) -> Tensor:
        """Values `[C, S, B]`."""
        shape = _check(contexts, theta_i, phi)
        c, t = _matched(contexts, shape), self.tables
        context = c.theta_r, c.n, c.v
        value = self.run.eval(t.constants, t.records, t.averages, context, _flat(theta_i, c), _flat(phi, c))
        return value.reshape(-1, *shape)

    def log_prob(self, contexts: Contexts, theta_i: Tensor, phi: Tensor) -> Tensor:
        """Log density `[S, B]`."""
        shape = _check(contexts, theta_i, phi)
        c = _matched(contexts, shape)
        mixture = c.fields, c.sphere
        return self.run.log_prob(self.tables.records, c.theta_r, mixture, _flat(theta_i, c), _flat(phi, c)).reshape(
            shape
        )

    def sample(self, contexts: Contexts, u: Tensor) -> tuple[Tensor, Tensor]:
        """theta_i, phi `[S, B]`."""
        shape = _check(contexts, u[..., 0])
        c = _matched(contexts, shape)
        theta_i, phi = self.run.sample(c.theta_r, c.fields, self.tables.laws, _flat(u, c, 3))
        return theta_i.reshape(shape), phi.reshape(shape)

    def sample_eval(self, contexts: Contexts, u: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """theta_i, phi, density `[S, B]` and values `[C, S, B]`."""
        shape = _check(contexts, u[..., 0])
        c, t = _matched(contexts, shape), self.tables
        context, mixture = (c.theta_r, c.n, c.v), (c.fields, c.sphere)
        theta_i, phi, pdf, value = self.run.sample_eval(
            t.constants, t.records, t.averages, t.laws, context, mixture, _flat(u, c, 3)
        )
        return theta_i.reshape(shape), phi.reshape(shape), pdf.reshape(shape), value.reshape(-1, *shape)


def _check(contexts: Contexts, *given: Tensor) -> torch.Size:
    """The shape `[S, B]` of float32 directions for these contexts."""
    for value in given:
        if value.dtype != torch.float32:
            raise InputError("directions or uniforms", value.dtype, "torch.float32")
        if value.ndim != 2 or value.shape[1] != len(contexts) or value.shape != given[0].shape:
            raise InputError("directions or uniforms", tuple(value.shape), f"shape [S, {len(contexts)}]")
    return given[0].shape


def _matched(contexts: Contexts, shape: torch.Size) -> Contexts:
    """Contexts so that the inner loop is long: a few contexts with many samples each are repeated."""
    samples, batch = shape
    return contexts.repeated(samples) if 1 < batch < _FEW and samples > 1 else contexts


def _flat(value: Tensor, contexts: Contexts, last: int = 0) -> Tensor:
    """Directions `[S, B]`, or `[N]` where one context or one per direction is left; uniforms with a last dimension."""
    tail = (last,) if last else ()
    value = value.reshape(-1, len(contexts), *tail)
    return value.reshape(-1, *tail) if 1 in value.shape[:2] else value


def build_program(kernel: HairKernel, need: str) -> Program:
    """The program for contexts of one kind: terms, components and records that they need."""
    proposal, bsdf = kernel.mixture, kernel.bsdf
    dropped = {"both": (), "direct": SCATTERED, "scattered": DIRECT}[need]
    components = [k for k, name in enumerate(proposal.names) if name not in dropped]
    tables: list[int] = []
    laws: list[int | str] = []
    for k in components:
        law = proposal.laws[k]
        if isinstance(law, FiberAzimuth):
            number = kernel.laws.number[k]
            if number not in tables:
                tables.append(number)
            laws.append(tables.index(number))
        else:
            laws.append("back" if isinstance(law, BackHalf) else "all")
    layout = Layout(
        channels=kernel.computed_channels,
        direct=() if need == "scattered" else kernel.halves["direct"],
        scattered=() if need == "direct" else kernel.halves["scattered"],
        half_back=bsdf.convention.back_azimuth == "back",
        laws=tuple(laws),
        rows=kernel.grid.rows,
        columns=kernel.grid.columns,
        law_rows=kernel.laws.grid.rows,
        law_columns=kernel.laws.grid.columns,
        knots=len(kernel.averages),
    )
    density = kernel.laws.density[tables]
    tensors = Tables(
        constants=_constants(kernel),
        records=_records(kernel, layout, density),
        averages=kernel.averages.flatten(1).to(torch.float32).contiguous(),
        laws=tuple(x.to(torch.float32).flatten().contiguous() for x in (density, kernel.laws.cumulative[tables])),
    )
    return Program(layout, tensors, components, functions(layout, kernel.backend == "compiled"))


def _constants(kernel: HairKernel) -> Tensor:
    """In the order of `evaluate.Constants`."""
    bsdf, fiber = kernel.bsdf, kernel.fiber
    c_m, d_b, d_f = bsdf.convention.lobe_constant, float(bsdf.d_b), float(bsdf.d_f)
    head = [
        float(fiber.eta),
        c_m,
        2 * c_m * d_b / math.pi,
        bsdf.convention.density_power * math.log(max(d_f, 1e-38)),
        math.pi if bsdf.convention.back_factor == "pi" else 1.0,
    ]
    rest = [fiber.alpha.detach(), fiber.beta.detach() ** 2, fiber.sigma_a.detach()]
    return torch.cat([torch.tensor(head, dtype=torch.float64), *(x.double() for x in rest)]).to(torch.float32)


def _records(kernel: HairKernel, layout: Layout, density: Tensor) -> Tensor:
    """`[rows * columns, width]`: laws, then azimuths, then zeros up to the width."""
    laws = refined(density, layout.rows, layout.columns).movedim(0, -1)
    parts = [laws, *(kernel.columns[name] for name in layout.tabulated())]
    whole = torch.cat(parts, dim=-1)
    missing = layout.width - whole.shape[-1]
    return torch.nn.functional.pad(whole, (0, missing)).flatten(0, 1).to(torch.float32).contiguous()
