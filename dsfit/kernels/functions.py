"""The four functions of a kernel on plain float32 tensors, in torch."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from dsfit.kernels.contexts import mixture_fields
from dsfit.kernels.density import density, log_density
from dsfit.kernels.draw import draw
from dsfit.kernels.evaluate import evaluate
from dsfit.kernels.geometry import Cell, Direction, Records
from dsfit.kernels.layout import Layout


@dataclass(frozen=True)
class Tables:
    """Float32 tensors that every call reads.

    Attributes:
        constants: of the fibre, in the order of `evaluate.Constants`.
        records: `[rows * columns, width]`.
        averages: `[knots, 5 C]`.
        laws: density and CDF of |phi|, each flat `[tables * law_rows * law_columns]`, and the guides to their columns.
    """

    constants: Tensor
    records: Tensor
    averages: Tensor
    laws: tuple[Tensor, Tensor, Tensor]


@dataclass(frozen=True)
class Functions:
    """`context` is theta_r, n, v; `mixture` is fields and sphere; directions are `[S, B]` or `[N]` with contexts `[B]`
    or `[1]`. `fields` writes `contexts.mixture_fields`.

    Compiled code has three more, for proposals that `moments.is_served`: `prepare` gives the fields of contexts; `sort`
    counts (and lists) contexts by what they need, and finds those that are not valid; `shade` prepares, draws and
    evaluates.
    """

    eval: Callable[..., Tensor]
    log_prob: Callable[..., Tensor]
    sample: Callable[..., tuple[Tensor, Tensor]]
    sample_eval: Callable[..., tuple[Tensor, ...]]
    fields: Callable[..., None]
    prepare: Callable[..., Tensor] | None = None
    sort: Callable[..., dict[str, int] | None] | None = None
    shade: Callable[..., None] | None = None


def plain_functions(layout: Layout) -> Functions:
    """The functions of one layout in torch: what the compiled ones must agree with, and their stand-in."""

    def prepared(records: Tensor, theta_r: Tensor, theta_i: Tensor, phi: Tensor) -> tuple[Direction, Records]:
        direction = Direction.at(theta_i, phi, theta_r)
        return direction, Records(records, Cell.of(direction, layout.rows, layout.columns), layout)

    def evaluated(
        constants: Tensor, records: Tensor, averages: Tensor, context: tuple, theta_i: Tensor, phi: Tensor
    ) -> Tensor:
        direction, cells = prepared(records, context[0], theta_i, phi)
        return torch.stack(evaluate(layout, constants, averages, context, direction, cells, theta_i))

    def log_prob(records: Tensor, theta_r: Tensor, mixture: tuple, theta_i: Tensor, phi: Tensor) -> Tensor:
        direction, cells = prepared(records, theta_r, theta_i, phi)
        return log_density(density(layout, *mixture, direction, cells))

    def sample(theta_r: Tensor, fields: Tensor, laws: tuple, u: Tensor) -> tuple[Tensor, Tensor]:
        return draw(layout, fields, theta_r, laws, u.unbind(-1))

    def sample_eval(
        constants: Tensor, records: Tensor, averages: Tensor, laws: tuple, context: tuple, mixture: tuple, u: Tensor
    ) -> tuple[Tensor, ...]:
        theta_i, phi = draw(layout, mixture[0], context[0], laws, u.unbind(-1))
        direction, cells = prepared(records, context[0], theta_i, phi)
        pdf = density(layout, *mixture, direction, cells)
        value = evaluate(layout, constants, averages, context, direction, cells, theta_i)
        return theta_i, phi, pdf, torch.stack(value)

    def fields(theta_r: Tensor, given: tuple[Tensor, ...], components: list[int], out: Tensor) -> None:
        out.copy_(mixture_fields(theta_r, given, components))

    return Functions(evaluated, log_prob, sample, sample_eval, fields)
