"""A kernel for one half or both halves of the integrand: its tensors, and calls on prepared contexts."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from dsfit.errors import InputError
from dsfit.kernels.contexts import Contexts
from dsfit.kernels.functions import Functions, Tables
from dsfit.kernels.layout import BLOCK, Layout
from dsfit.kernels.moments import Start, is_served, packed
from dsfit.kernels.tables import guides, refined
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
        run: the functions, on directions `[N]` with contexts `[1]` or `[N]`, or `[S, B]` with contexts `[B]`.
        start: what compiled code prepares contexts from; None where torch does.
    """

    def __init__(
        self, layout: Layout, tables: Tables, components: list[int], run: Functions, start: Start | None = None
    ) -> None:
        self.layout, self.tables, self.components, self.run, self.start = layout, tables, components, run, start

    def eval(self, contexts: Contexts, theta_i: Tensor, phi: Tensor) -> Tensor:
        """Values `[C, S, B]`."""
        c, theta, azimuth = _arranged(contexts, theta_i, phi)
        t = self.tables
        value = self.run.eval(t.constants, t.records, t.averages, (c.theta_r, c.n, c.v), theta, azimuth)
        return _restored(value, theta_i.shape, channels=True)

    def log_prob(self, contexts: Contexts, theta_i: Tensor, phi: Tensor) -> Tensor:
        """Log density `[S, B]`."""
        c, theta, azimuth = _arranged(contexts, theta_i, phi)
        value = self.run.log_prob(self.tables.records, c.theta_r, (c.fields, c.sphere), theta, azimuth)
        return _restored(value, theta_i.shape)

    def sample(self, contexts: Contexts, u: Tensor) -> tuple[Tensor, ...]:
        """theta_i, phi `[S, B]`."""
        c, uniforms = _arranged(contexts, u)
        drawn = self.run.sample(c.theta_r, c.fields, self.tables.laws, uniforms)
        return tuple(_restored(x, u.shape[:2]) for x in drawn)

    def sample_eval(self, contexts: Contexts, u: Tensor) -> tuple[Tensor, ...]:
        """theta_i, phi, density `[S, B]` and values `[C, S, B]`."""
        c, uniforms = _arranged(contexts, u)
        t = self.tables
        context, mixture = (c.theta_r, c.n, c.v), (c.fields, c.sphere)
        found = self.run.sample_eval(t.constants, t.records, t.averages, t.laws, context, mixture, uniforms)
        return tuple(_restored(x, u.shape[:2], channels=i == 3) for i, x in enumerate(found))


def _arranged(contexts: Contexts, *given: Tensor) -> tuple:
    """Contexts and directions or uniforms `[S, B, ...]` in the form that functions take: long inner loops.

    One context, or one direction for each, makes a single dimension; a few contexts with many directions each are
    repeated; and less than a block is filled up with copies.
    """
    for value in given:
        if value.dtype != torch.float32:
            raise InputError("directions or uniforms", value.dtype, "torch.float32")
        if value.shape[:2] != given[0].shape[:2] or value.ndim < 2 or value.shape[1] != len(contexts):
            raise InputError("directions or uniforms", tuple(value.shape), f"shape [S, {len(contexts)}, ...]")
        if not value.numel():
            raise InputError("directions or uniforms", tuple(value.shape), "at least one direction")
    samples, batch = given[0].shape[:2]
    if 1 < batch < _FEW and samples > 1:
        contexts = contexts.repeated(samples)
    elif batch > 1 and samples > 1:
        return contexts, *(x.contiguous() for x in given)
    count, missing = samples * batch, BLOCK - samples * batch
    flat = [x.reshape(count, *x.shape[2:]) for x in given]
    if missing > 0:
        index = torch.arange(BLOCK).clamp_max(count - 1)
        flat = [x[index] for x in flat]
        contexts = contexts[index] if batch > 1 else contexts
    return contexts, *(x.contiguous() for x in flat)


def _restored(value: Tensor, shape: torch.Size, channels: bool = False) -> Tensor:
    """Results for `[S, B]` directions; what filled up a block is dropped. Channels stay in front."""
    if shape.numel() < BLOCK:
        value = value[..., : shape.numel()]
    return value.reshape(value.shape[0], *shape) if channels else value.reshape(shape)


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
        poisson=bsdf.convention.transmittance == "poisson",
        components=tuple(components),
        back_lobe="back" in proposal.names,
        laws=tuple(laws),
        rows=kernel.grid.rows,
        columns=kernel.grid.columns,
        law_rows=kernel.laws.grid.rows,
        law_columns=kernel.laws.grid.columns,
        knots=len(kernel.averages),
    )
    density, cumulative = kernel.laws.density[tables], kernel.laws.cumulative[tables].float()
    tensors = Tables(
        constants=_constants(kernel),
        records=_records(kernel, layout, density),
        averages=_averages(kernel),
        laws=(density.float().flatten(), cumulative.flatten(), guides(cumulative).flatten()),
    )
    run = kernel.functions(layout)
    start = packed(kernel.snapshot, components) if run.prepare and is_served(kernel.snapshot) else None
    return Program(layout, tensors, components, run, start)


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


def _averages(kernel: HairKernel) -> Tensor:
    """`[knots, 5 C]`, rows filled up to whole cache lines."""
    flat = kernel.averages.flatten(1)
    return torch.nn.functional.pad(flat, (0, -flat.shape[1] % 16)).to(torch.float32).contiguous()


def _records(kernel: HairKernel, layout: Layout, density: Tensor) -> Tensor:
    """`[rows * columns, width]`: laws, then azimuths, then zeros up to the width."""
    laws = refined(density, layout.rows, layout.columns).movedim(0, -1)
    parts = [laws, *(kernel.columns[name] for name in layout.tabulated())]
    whole = torch.cat(parts, dim=-1)
    missing = layout.width - whole.shape[-1]
    return torch.nn.functional.pad(whole, (0, missing)).flatten(0, 1).to(torch.float32).contiguous()
