"""What a solver is given: a function of a parameter vector, as value, gradient, or compressed least-squares system.

A least-squares problem minimises `sum_i r_i(y)^2`. With the thin QR factorisation of the matrix [J | r] (N rows of
residuals, P + 1 columns), `[J | r] = Q R`, the last column of R and the columns before it,

    r~ = R[:, P],  J~ = R[:, :P],       have  J~^T J~ = J^T J,  J~^T r~ = J^T r,  |r~| = |r|,

because Q has orthonormal columns: `R^T R = [J | r]^T [J | r]`. Gauss-Newton, Levenberg-Marquardt and dogleg steps, and
the reduction that they predict, depend on nothing else, so a solver that sees (r~, J~) takes the same steps with P + 1
rows as with ten thousand.
"""

from __future__ import annotations

import math
import threading
from abc import ABC, abstractmethod
from collections.abc import Callable

import torch
from torch import Tensor

TRANSFORMS = threading.RLock()
"""Held around torch.func transforms: torch's forward mode keeps its level in one variable for all threads."""


def compress(residuals: Tensor, jacobian: Tensor, *, rows: int = 65536) -> tuple[Tensor, Tensor]:
    """Compressed residuals [P + 1] and Jacobian [P + 1, P] with the same norm, gradient and normal matrix (module
    docstring).

    Args:
        residuals: [N], any float dtype; the result is float64 on the same device.
        jacobian: [N, P].
        rows: rows factored at a time; more are folded in one block after another, `R <- qr([R; next rows])`, in
            bounded memory.

    The factors are made unique by a non-negative diagonal, so they are continuous in the input where [J | r] has full
    rank. With fewer than P + 1 residuals, rows of zeros are appended. A non-finite input gives non-finite results.
    """
    stacked = torch.cat([jacobian, residuals[:, None]], dim=1).to(torch.float64)
    size = stacked.shape[1]
    if not bool(torch.isfinite(stacked).all()):
        full = torch.full((size, size), torch.nan, dtype=torch.float64, device=stacked.device)
        return full[:, -1], full[:, :-1]
    factor = stacked[:0]
    for start in range(0, len(stacked), max(rows, size)):
        block = torch.cat([factor, stacked[start : start + max(rows, size)]])
        factor = torch.linalg.qr(block, mode="r").R
    sign = torch.where(factor.diagonal() < 0, -1.0, 1.0)
    factor = sign[:, None] * factor
    factor = torch.cat([factor, factor.new_zeros(size - len(factor), size)])
    return factor[:, -1], factor[:, :-1]


def gauss_newton_gap(residuals: Tensor, jacobian: Tensor, *, rcond: float = 1e-9, reach: float = float("inf")) -> float:
    """By how much an undamped Gauss-Newton step promises to lower `sum r^2`: the squared norm of r projected on the
    range of J.

    The range is taken as the left singular vectors of J, its columns scaled to unit length first, whose singular value
    exceeds `rcond` times the largest, so that neither the units of the parameters nor directions that are only
    rounding noise matter. NaN for non-finite input.

    Where that step moves a parameter by more than `reach`, the linear model is believed only so far: the result is
    what the best step of length `reach sqrt(P)` promises, which is at least what any step within reach does. A
    parameter close to a bound that lies at infinity, such as the logit of a share that vanishes, promises nothing.
    """
    if not bool(torch.isfinite(residuals).all() & torch.isfinite(jacobian).all()):
        return float("nan")
    length = jacobian.norm(dim=0)
    length = torch.where(length > 0, length, 1.0)
    u, s, vh = torch.linalg.svd(jacobian / length, full_matrices=False)
    if not len(s) or not s[0] > 0:
        return 0.0
    kept = s > rcond * s[0]
    along = (u.T @ residuals)[kept]
    step = (vh[kept].T @ (along / s[kept])) / length
    promise = float(along.square().sum())
    if not float(step.abs().max()) > reach:
        return promise
    return min(promise, _promise_within(residuals, jacobian, reach * len(step) ** 0.5))


def _promise_within(residuals: Tensor, jacobian: Tensor, radius: float) -> float:
    """The most by which `|r + J x|^2` falls below `|r|^2` for |x| <= radius, by bisection for the multiplier `mu` of
    `x = -(J^T J + mu)^-1 J^T r`, whose length falls as mu grows."""
    u, s, _ = torch.linalg.svd(jacobian, full_matrices=False)
    along = u.T @ residuals
    low, high = -80.0, 80.0  # logarithm of mu in units of s_max^2
    for _ in range(100):
        middle = 0.5 * (low + high)
        damped = s.square() + s[0].square() * math.exp(middle)
        if float((s * along / damped).norm()) > radius:
            low = middle
        else:
            high = middle
    share = s.square() / (s.square() + s[0].square() * math.exp(low))  # the longer side: never too small a promise
    return float((along.square() * share * (2 - share)).sum())


def forward_jacobian(
    function: Callable[[Tensor], Tensor], y: Tensor, chunk: int | None = None
) -> tuple[Tensor, Tensor]:
    """Value [N] and Jacobian [N, P] by forward mode, `chunk` columns at a time (all at once if None)."""

    def column(tangent: Tensor) -> tuple[Tensor, Tensor]:
        return torch.func.jvp(function, (y,), (tangent,))

    basis = torch.eye(y.numel(), dtype=y.dtype, device=y.device)
    with TRANSFORMS:
        parts = [torch.func.vmap(column, out_dims=(None, -1))(part) for part in basis.split(chunk or len(basis))]
    return parts[0][0], torch.cat([jacobian for _, jacobian in parts], dim=-1)


class Problem(ABC):
    """A function to be minimised over a vector of `size` float64 parameters.

    `value` is `sum r^2` where `least_squares`, else the scalar itself. Results may be non-finite; solvers deal with
    that. A problem that is not least squares may yet have `gauss_newton`: `linearise` then gives residuals and a
    Jacobian whose `2 J^T r` is the gradient and whose `2 J^T J` approximates the Hessian.
    """

    size: int
    least_squares: bool
    gauss_newton: bool = False

    @abstractmethod
    def value(self, y: Tensor) -> float:
        """The value at `y` [P]."""

    @abstractmethod
    def gradient(self, y: Tensor) -> tuple[float, Tensor]:
        """The value and its gradient [P]."""

    def linearise(self, y: Tensor) -> tuple[Tensor, Tensor]:
        """Compressed residuals [P + 1] and Jacobian [P + 1, P]; only where `least_squares` or `gauss_newton`."""
        raise NotImplementedError

    def sampled_gradient(self, y: Tensor, count: int, generator: torch.Generator) -> tuple[float, Tensor]:
        """Unbiased estimate of value and gradient from `count` terms of a mean; problems that are no mean give all."""
        return self.gradient(y)


class FunctionProblem(Problem):
    """A torch function of a float64 vector: residuals [N] (least squares) or a scalar.

    Args:
        function: vector [P] to vector [N] or scalar; differentiable by torch.func.
        y0: a vector of the right size, used to see which of the two the function returns.
        reverse: Jacobian by reverse mode, for fewer residuals than parameters; left out, that comparison decides.
        chunk: columns (forward) or rows (reverse) of the Jacobian computed at a time.
    """

    def __init__(
        self, function: Callable[[Tensor], Tensor], y0: Tensor, *, reverse: bool | None = None, chunk: int | None = None
    ) -> None:
        self.function, self.size, self.chunk = function, y0.numel(), chunk
        with torch.no_grad():
            start = function(y0.detach())
        self.least_squares = start.ndim > 0
        self.reverse = start.numel() < self.size if reverse is None else reverse

    def value(self, y: Tensor) -> float:
        with torch.no_grad():
            result = self.function(y)
        return float(result.square().sum() if self.least_squares else result)

    def gradient(self, y: Tensor) -> tuple[float, Tensor]:
        y = y.detach().requires_grad_()
        with torch.enable_grad():
            result = self.function(y)
            value = result.square().sum() if self.least_squares else result
            if not value.requires_grad:
                return float(value), torch.zeros_like(y)
            (gradient,) = torch.autograd.grad(value, y, allow_unused=True)
        return float(value.detach()), torch.zeros_like(y) if gradient is None else gradient

    def linearise(self, y: Tensor) -> tuple[Tensor, Tensor]:
        def twice(y: Tensor) -> tuple[Tensor, Tensor]:
            result = self.function(y)
            return result, result

        if self.reverse:
            with TRANSFORMS:
                jacobian, residuals = torch.func.jacrev(twice, has_aux=True, chunk_size=self.chunk)(y)
        else:
            residuals, jacobian = forward_jacobian(self.function, y, self.chunk)
        return compress(residuals.detach(), jacobian.detach())
