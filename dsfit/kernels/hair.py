"""Float32 kernels of the dual scattering BSDF and its amortised proposal, as a renderer calls them."""

from __future__ import annotations

import copy
import math
from typing import Any, NamedTuple

import torch
from torch import Tensor

from dsfit.bsdf.dual_scattering import DualScattering
from dsfit.bsdf.grey import first_channel
from dsfit.bsdf.terms import TERMS, Terms
from dsfit.context import Context
from dsfit.errors import InputError, as_real, check_choice
from dsfit.kernels.adapters import KernelIntegrand, KernelProposal
from dsfit.kernels.contexts import Contexts, need_of
from dsfit.kernels.functions import Functions, plain_functions
from dsfit.kernels.layout import FIELDS, NEEDS, Layout
from dsfit.kernels.native import NoCompiler, native_functions
from dsfit.kernels.program import Program, build_program
from dsfit.kernels.shade import are_plain, check_uniforms, shade
from dsfit.kernels.tables import Grid, average_table, azimuth_columns, check_served, law_tables
from dsfit.proposals.amortised import AmortisedProposal
from dsfit.scene.lights import Light

_AT_ONCE = 1024  # contexts that are prepared at once: their intermediate numbers stay in cache
_FINER = (2, 1)
"""Cells of the records in one cell of the proposal's azimuth tables, in theta_diff and in phi."""


class _Plain(NamedTuple):
    """What a proposal's shape is asked for, known to be valid."""

    theta_r: Tensor
    n: Tensor
    v: Tensor


class HairKernel:
    """eval, log_prob, sample and sample + pdf + eval of one fibre in float32.

    Args:
        bsdf: a round `marschner` fibre in the "consistent" form of the equations.
        proposal: what is sampled; left out, an untrained `AmortisedProposal`. A copy is kept as it is now.
        terms: which terms of F are computed.
        mode: "compiled" (C++, built for this machine at first use and cached), "eager" (torch), or "auto": compiled
            where there is a compiler, else eager. `backend` tells which, and why.

    Angles are radians. `theta_i`, `phi = phi_r - phi_i` are `[S, B]`, uniforms `u` `[S, B, 3]`, contexts `[B]`, all
    float32. Densities are per steradian. Values are `[S, B, C]` with the channels outermost in memory.

    Nothing is checked per direction: angles must be finite and |theta_i| <= pi/2; then results are finite.

    Raises:
        InputError: a fibre that the tables do not serve, a proposal of another kind, terms without the glint where TRT
            is needed, mode "compiled" without a compiler.
    """

    def __init__(
        self,
        bsdf: DualScattering,
        proposal: AmortisedProposal | None = None,
        *,
        terms: Terms | None = None,
        mode: str = "auto",
    ) -> None:
        check_served(bsdf)
        check_choice("mode", mode, ("auto", "compiled", "eager"))
        self.bsdf, self.terms = bsdf, bsdf.terms if terms is None else terms
        self.halves = {half: _served_terms(bsdf, getattr(self.terms, half)) for half in ("direct", "scattered")}
        if not self.terms.glint and any("TRT" in names for names in self.halves.values()):
            raise InputError("terms.glint", False, "True where TRT is needed: its caustic has no finite table")
        self.mixture = AmortisedProposal(bsdf) if proposal is None else proposal
        if not isinstance(self.mixture, AmortisedProposal):
            raise InputError("proposal", type(proposal).__name__, "a dsfit AmortisedProposal")
        self.backend, self._mode = "eager" if mode == "eager" else "compiled", mode
        self.fiber = first_channel(bsdf.fiber) if self.terms.grey else bsdf.fiber
        own = bsdf.replace(fiber=self.fiber, terms=Terms())
        self.laws = law_tables(self.mixture)
        rows, columns = self.laws.grid.rows, self.laws.grid.columns
        self.grid = Grid((rows - 1) * _FINER[0] + 1, (columns - 1) * _FINER[1] + 1)
        self.columns = azimuth_columns(own, self.grid)
        self.averages = average_table(own)
        self.snapshot = copy.deepcopy(self.mixture).to(torch.float32).requires_grad_(False)
        self.sphere = self.mixture.defensive / (4 * math.pi)
        self._sphere = torch.tensor(self.sphere, dtype=torch.float32)
        self._programs: dict[str, Program] = {}
        self.program("both")

    def functions(self, layout: Layout) -> Functions:
        """The functions of a layout: compiled, or eager where that is asked for or nothing else works."""
        if self.backend == "compiled":
            try:
                return native_functions(layout)
            except NoCompiler as error:
                if self._mode == "compiled":
                    raise InputError("mode", "compiled", f"'eager' or 'auto' here: {error}") from None
                self.backend = f"eager: {error}"
        return plain_functions(layout)

    @property
    def computed_channels(self) -> int:
        """Number of channels that are computed: 1 for grey terms."""
        return self.fiber.channels

    @property
    def channels(self) -> int:
        """Number of channels C of values."""
        return self.bsdf.channels

    def prepare(self, theta_r: Any, n: Any = 0.0, v: Any = None) -> Contexts:
        """Everything that depends on the context alone, for contexts `[B]` (see `Context` for what is allowed).

        Fastest for three float32 tensors `[B]`: they are checked as they are read.
        """
        if are_plain(theta_r, n, v) and (sort := self.program("both").run.sort):
            counts = sort(theta_r, n, v, None)
            if counts is not None:
                need = next((name for name in NEEDS[1:] if len(v) and counts[name] == len(v)), "both")
                return self._prepared(theta_r, n, v, need)
        return self.prepare_context(self._context(theta_r, n, v))

    def prepare_context(self, context: Context) -> Contexts:
        """`prepare` for a `Context` of batch shape `[B]`."""
        bare = self.bare_contexts(context)
        return self._prepared(bare.theta_r, bare.n, bare.v, bare.need)

    def _context(self, theta_r: Any, n: Any, v: Any) -> Context:
        given = (None if x is None else as_real("context", x, torch.float32) for x in (theta_r, 0.0, n, v))
        return Context(*given).reshape(-1)

    def _prepared(self, theta_r: Tensor, n: Tensor, v: Tensor, need: str) -> Contexts:
        program = self.program(need)
        if program.start is None:
            fields = self._shaped(program, theta_r, n, v)
        else:
            fields = program.run.prepare(program.start, theta_r, n, v)
        return Contexts(theta_r, n, v, fields, self._sphere, need)

    @torch.no_grad()
    def _shaped(self, program: Program, theta_r: Tensor, n: Tensor, v: Tensor) -> Tensor:
        """Fields by the proposal's own shape."""
        fields = theta_r.new_empty(len(FIELDS), len(program.components), len(theta_r))
        for start in range(0, len(theta_r), _AT_ONCE):
            some = slice(start, start + _AT_ONCE)
            shape = self.snapshot.shape(_Plain(theta_r[some], n[some], v[some]))
            given = (shape.log_weights, shape.mode, shape.below, shape.above)
            program.run.fields(theta_r[some], given, program.components, fields[..., some])
        return fields

    def bare_contexts(self, context: Context) -> Contexts:
        """Contexts that `eval` takes, without a mixture."""
        theta_r, n, v = (x.to(torch.float32).contiguous() for x in (context.theta_r, context.n, context.v))
        return Contexts(theta_r, n, v, theta_r.new_empty(0), self._sphere, need_of(v))

    @torch.no_grad()
    def eval(self, contexts: Contexts, theta_i: Tensor, phi: Tensor) -> Tensor:
        """F cos(theta_i) `[S, B, C]`."""
        return self._values(self.program(contexts.need).eval(contexts, theta_i, phi))

    @torch.no_grad()
    def eval_each(self, theta_r: Tensor, n: Tensor, v: Tensor, theta_i: Tensor, phi: Tensor) -> Tensor:
        """F cos(theta_i) `[N, C]` of N directions with a context each, all float32 `[N]`; nothing is checked.

        For renderers, where n and v change with the direction.
        """
        if not len(theta_i):
            return theta_i.new_zeros(0, self.channels)
        each = (x.contiguous() for x in (theta_r, n, v))
        contexts = Contexts(*each, theta_r.new_empty(0), self._sphere, need_of(v))
        return self.eval(contexts, theta_i.unsqueeze(0), phi.unsqueeze(0))[0]

    @torch.no_grad()
    def log_prob(self, contexts: Contexts, theta_i: Tensor, phi: Tensor) -> Tensor:
        """Log density per steradian `[S, B]`."""
        return self.program(contexts.need).log_prob(contexts, theta_i, phi)

    @torch.no_grad()
    def sample(self, contexts: Contexts, u: Tensor) -> tuple[Tensor, Tensor]:
        """theta_i and phi `[S, B]` from uniforms."""
        return self.program(contexts.need).sample(contexts, u)

    @torch.no_grad()
    def sample_eval(self, contexts: Contexts, u: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """theta_i, phi, their density `[S, B]` and F cos(theta_i) `[S, B, C]`."""
        theta_i, phi, pdf, value = self.program(contexts.need).sample_eval(contexts, u)
        return theta_i, phi, pdf, self._values(value)

    @torch.no_grad()
    def shade(self, theta_r: Any, n: Any, v: Any, u: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """theta_i, phi, their density `[S, B]` and F cos(theta_i) `[S, B, C]` from uniforms `u` `[S, B, 3]`, as
        `sample_eval` of contexts `[B]` that are met once.

        Their mixtures never leave the cache, and every context is computed by the half it needs, whatever the others
        need. Contexts are given as for `prepare`.
        """
        context = theta_r, n, v
        if not are_plain(*context):
            plain = self.bare_contexts(self._context(*context))
            context = plain.theta_r, plain.n, plain.v
        check_uniforms(u, len(context[0]))
        found = shade(self, context, u) if self.program("both").start is not None else None
        if found is None:
            return self.sample_eval(self.prepare_context(self._context(*context)), u)
        return *found[:3], self._values(found[3])

    def integrand(self, light: Light | None = None) -> KernelIntegrand:
        """The BSDF times a light (a furnace, if left out) where an `Integrand` is asked for."""
        return KernelIntegrand(self, light)

    def proposal(self) -> KernelProposal:
        """The mixture where a `Proposal` is asked for."""
        return KernelProposal(self)

    def _values(self, value: Tensor) -> Tensor:
        return value.movedim(0, -1).expand(*value.shape[1:], self.channels)

    def program(self, need: str) -> Program:
        """What computes contexts of one kind."""
        if need not in self._programs:
            self._programs[need] = build_program(self, check_choice("need", need, NEEDS))
        return self._programs[need]


def _served_terms(bsdf: DualScattering, names: tuple[str, ...]) -> tuple[str, ...]:
    return tuple(t for t in TERMS if t in names and (t != "back" or bool(bsdf.d_b > 0)))
