"""Reverse mode, forward mode and extrapolated differences, side by side."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import torch
from torch import Tensor
from torch.func import jvp

from dsfit.checks.gradients.differences import LEVELS, SAFETY, derivative

Values = Mapping[str, Tensor]
Function = Callable[[dict[str, Tensor]], Tensor]
"""Named tensors to one tensor `[...]`, float64."""

CLEAR = 1e-3
"""Differences say something where their own error is below this share of |derivative| + |f| per unit."""
MODES_AGREE = 1e-8
"""Largest difference of the two modes relative to |derivative| + |f|: they round differently, and in nothing else."""
ROUNDING = 1e-12
"""Of automatic differentiation itself, relative to |derivative| + |f|."""


@dataclass(frozen=True)
class DerivativeCheck:
    """Derivatives of one function in one of its inputs, `[P, *output]` for P elements of a shared input, `[1,
    *output]` for an input that each output has its own of.

    Attributes:
        name: of the input.
        numeric, error: extrapolated differences and the estimate of their error.
        reverse, forward: by automatic differentiation; `forward` None where forward mode raised (`refused` says what).
        tolerance: `SAFETY error + floor (|numeric| + |f|)`.
        clear: where the differences are good enough to judge by; elsewhere is a kink, a jump, or something narrower
            than the smallest step.
    """

    name: str
    numeric: Tensor
    error: Tensor
    reverse: Tensor
    forward: Tensor | None
    tolerance: Tensor
    clear: Tensor
    scale: Tensor = field(repr=False)
    refused: str = ""

    @property
    def worst(self) -> float:
        """Largest deviation of either mode over its tolerance, among clear elements; 1 is the limit; NaN derivatives
        are infinitely wrong."""
        if not bool(self.clear.any()):
            return 0.0
        modes = [self.reverse] if self.forward is None else [self.reverse, self.forward]
        ratios = [((x - self.numeric).abs() / self.tolerance)[self.clear] for x in modes]
        return float(torch.cat(ratios).nan_to_num(nan=torch.inf).max())

    @property
    def apart(self) -> float:
        """Largest difference of the two modes relative to |derivative| + |f|, over all elements; 0 without forward
        mode."""
        if self.forward is None or not self.reverse.numel():
            return 0.0
        gap = (self.reverse - self.forward).abs()
        ratio = torch.where(gap == 0, 0.0, gap / self.scale)  # 0 / 0: a function that is zero all around
        return float(ratio.nan_to_num(nan=torch.inf).max())

    @property
    def unclear_share(self) -> float:
        """Share of elements where differences cannot tell."""
        return float((~self.clear).double().mean()) if self.clear.numel() else 0.0

    @property
    def sharpness(self) -> float:
        """Median over clear elements of tolerance over |derivative| + |f|: how small an error would be seen."""
        ratio = (self.tolerance / self.scale.clamp_min(torch.finfo(torch.float64).tiny))[self.clear]
        return float(ratio.median()) if ratio.numel() else float("nan")


def check_derivative(
    function: Function,
    values: Values,
    name: str,
    *,
    own: bool = False,
    step: float | Tensor = 0.1,
    levels: int = LEVELS,
    at_once: bool = False,
    forward: bool = True,
    floor: float = ROUNDING,
) -> DerivativeCheck:
    """Compare the derivatives of `function` in its input `name`.

    Args:
        function: of named tensors, to `[...]`; must be finite at `values`.
        values: where to take the derivatives.
        name: the input; any shape.
        own: the input has the shape of the output's first dimensions, and every output depends on its own element alone
            (directions, uniforms). Otherwise every output may depend on every element.
        step: largest step of the differences, a number or (with `own`) a tensor of the input's shape: within it, the
            function has to be defined.
        levels: number of steps.
        at_once: `function` also takes the input with one more dimension in front, which its result then has as well;
            the differences are then one call.
        forward: whether forward mode is tried as well.
        floor: what the function itself is smooth to, relative to |derivative| + |f|.
    """
    values = {key: value.detach() for key, value in values.items()}
    if own:
        steps = torch.as_tensor(step).expand(values[name].shape)
        return _check_own(function, values, name, steps, levels, at_once, floor)
    point = values[name]
    numeric, error, scale = [], [], []
    units = torch.eye(point.numel(), dtype=point.dtype).reshape(-1, *point.shape)
    for unit in units:

        def along(t: Tensor, unit: Tensor = unit) -> Tensor:
            with torch.no_grad():
                return function({**values, name: point + t.reshape(t.shape + (1,) * point.dim()) * unit})

        found = derivative(along, step, levels=levels, at_once=at_once)
        numeric.append(found.value)
        error.append(found.error)
        scale.append(found.scale)
    reverse = _reverse(function, values, name)
    ahead, refused = _forward(function, values, name, units) if forward else (None, "")
    return _compared(name, torch.stack(numeric), torch.stack(error), torch.stack(scale), reverse, ahead, refused, floor)


def _compared(
    name: str,
    numeric: Tensor,
    error: Tensor,
    size: Tensor,
    reverse: Tensor,
    forward: Tensor | None,
    refused: str,
    floor: float,
) -> DerivativeCheck:
    scale = numeric.abs().nan_to_num(nan=0.0) + size
    tolerance = SAFETY * error + floor * scale + torch.finfo(torch.float64).tiny
    clear = error <= CLEAR * scale
    return DerivativeCheck(name, numeric, error, reverse, forward, tolerance, clear, scale, refused)


def _check_own(
    function: Function, values: dict[str, Tensor], name: str, step: Tensor, levels: int, at_once: bool, floor: float
) -> DerivativeCheck:
    point = values[name]

    def of(x: Tensor) -> Tensor:
        return function({**values, name: x})

    def along(t: Tensor) -> Tensor:
        with torch.no_grad():
            return of(point + t)

    found = derivative(along, step, levels=levels, at_once=at_once)
    leaf = point.clone().requires_grad_()
    out = of(leaf)
    columns = []
    for column in out.reshape(*point.shape, -1).unbind(-1):
        if not out.requires_grad:  # a constant
            columns.append(torch.zeros_like(point))
            continue
        (slope,) = torch.autograd.grad(column.sum(), leaf, retain_graph=True, allow_unused=True)
        columns.append(torch.zeros_like(point) if slope is None else slope)
    reverse = torch.stack(columns, dim=-1).reshape(out.shape)
    try:
        forward, refused = jvp(of, (point,), (torch.ones_like(point),))[1].detach()[None], ""
    except (RuntimeError, NotImplementedError) as error:
        forward, refused = None, str(error).split("\n")[0][:120]
    size = found.scale[None]
    return _compared(name, found.value[None], found.error[None], size, reverse[None], forward, refused, floor)


def _reverse(function: Function, values: dict[str, Tensor], name: str) -> Tensor:
    """`[P, *output]`, by one backward pass for every output, vectorised."""
    leaf = values[name].clone().requires_grad_()
    out = function({**values, name: leaf})
    if not out.requires_grad:
        return torch.zeros(leaf.numel(), *out.shape, dtype=out.dtype)
    flat = out.reshape(-1)
    rows = torch.eye(len(flat), dtype=out.dtype)
    try:
        (slopes,) = torch.autograd.grad(flat, leaf, rows, is_grads_batched=True, allow_unused=True, retain_graph=True)
    except RuntimeError:  # an operation whose backward pass has no batching rule
        each = [torch.autograd.grad(flat, leaf, row, retain_graph=True, allow_unused=True)[0] for row in rows]
        slopes = None if each[0] is None else torch.stack(each)
    if slopes is None:
        return torch.zeros(leaf.numel(), *out.shape, dtype=out.dtype)
    return slopes.reshape(len(flat), -1).transpose(0, 1).reshape(-1, *out.shape).detach()


def _forward(function: Function, values: dict[str, Tensor], name: str, units: Tensor) -> tuple[Tensor | None, str]:
    def of(x: Tensor) -> Tensor:
        return function({**values, name: x})

    try:
        return torch.stack([jvp(of, (values[name],), (unit,))[1].detach() for unit in units]), ""
    except (RuntimeError, NotImplementedError) as error:
        return None, str(error).split("\n")[0][:120]
