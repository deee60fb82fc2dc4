"""Second derivatives: which ones automatic differentiation has, and which ones the library never promised."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from dsfit.checks.gradients.compare import DerivativeCheck, Function, Values, check_derivative

Status = Literal["agrees", "absent", "differs"]


@dataclass(frozen=True)
class SecondOrder:
    """Second derivatives of one function in one input.

    Attributes:
        check: derivatives of the gradient, by reverse mode over reverse mode and by differences of the gradient.
        status: "agrees"; "absent": reverse mode gives zeros where there is something; "differs": neither.
    """

    check: DerivativeCheck
    status: Status


def second_derivatives(
    function: Function, values: Values, name: str, *, step: float = 0.1, seed: int = 0, levels: int = 7
) -> SecondOrder:
    """Differentiate twice `sum_i w_i f_i`, with random weights w, in the input `name`.

    Fits by Gauss-Newton, pathwise and score-function gradients need first derivatives alone, and the library promises
    no more: samplers by inverse CDF and roots of Snell's law carry their first derivatives by one Newton step with a
    fixed slope. Densities are plain formulas and have all orders.
    """
    fixed = {key: value.detach() for key, value in values.items()}
    with torch.no_grad():
        shape = function(fixed).shape
    weights = torch.randn(shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)

    def gradient(at: dict[str, Tensor]) -> Tensor:
        with torch.enable_grad():
            leaf = at[name] if at[name].requires_grad else at[name].detach().requires_grad_()
            total = (weights * function({**fixed, name: leaf})).sum()
            if not total.requires_grad:
                return torch.zeros_like(leaf)
            (slope,) = torch.autograd.grad(total, leaf, create_graph=True, allow_unused=True)
        return torch.zeros_like(leaf) if slope is None else slope

    check = check_derivative(gradient, fixed, name, step=step, levels=levels, forward=False)
    status: Status = "agrees"
    if check.worst > 1:
        small = float(check.reverse.abs().max()) <= 1e-9 * float(check.numeric.abs().nan_to_num().max())
        status = "absent" if small else "differs"
    return SecondOrder(check, status)
