"""Torch functions inside JAX programs: one differentiable call, at home under jit, vmap, forward and reverse mode.

`bridge(fn)` wraps a torch function of one float64 vector as a JAX function: `jax.custom_jvp` around
`jax.pure_callback`. The rule asks torch once for value *and* dense Jacobian and returns `J @ dy`, which is linear in
the tangent, so forward mode, reverse mode, jit and vmap all follow. A `custom_vjp` would not do: optimistix's
least-squares solvers use forward mode.

Three hazards of `jax.pure_callback` on CPU shape the code (all reproduced with JAX 0.10 by the tests):

- `jax.enable_x64` holds for one thread only, and a callback may run on another, where JAX silently rounds float64 to
  float32. So numbers cross as pairs of uint32 words, which no setting touches, and the context manager is enough;
  JAX's global flag stays as it was.
- inputs above 100 kB reach the callback as copies still in flight on the very thread pool that the callback occupies,
  and waiting for them deadlocks. So inputs cross in pieces of 64 kB, which JAX copies at once. Outputs have no such
  limit.
- any JAX call inside the callback can deadlock the same way. The callback touches numpy and torch only.

JAX is imported with this module, and this module only when a solver or a caller needs it.
"""

from __future__ import annotations

import functools
import itertools
import weakref
from collections.abc import Callable
from contextlib import AbstractContextManager

import jax
import numpy as np
import torch
from jax import lax
from torch import Tensor

from dsfit.errors import InputError
from dsfit.fit.problem import TRANSFORMS, forward_jacobian

PIECE = 8192
"""How many float64 numbers cross in one piece: 64 kB, below the 100 kB up to which JAX copies without its thread
pool."""

TorchFunction = Callable[[Tensor], Tensor]
ValueAndJacobian = Callable[[Tensor], tuple[Tensor, Tensor]]

_table: dict[int, tuple[TorchFunction, ValueAndJacobian]] = {}
_tokens = itertools.count(1)


def x64() -> AbstractContextManager[None]:
    """Context in which JAX, in this thread, traces float64; bridged functions are traced and called inside it."""
    return jax.enable_x64(True)


def value_and_jacobian(fn: TorchFunction, y: Tensor) -> tuple[Tensor, Tensor]:
    """Value [...] and dense Jacobian [..., P] of a torch function of a vector [P]: reverse mode for a scalar, else
    forward mode."""
    if fn(y.detach()).ndim == 0:
        with TRANSFORMS:
            gradient, value = torch.func.grad_and_value(fn)(y)
        return value, gradient
    return forward_jacobian(fn, y)


def register(fn: TorchFunction, jacobian: ValueAndJacobian | None = None) -> int:
    """Make `fn` known to bridged programs; returns the token by which `call` finds it, to be given to `release` when
    done.

    Args:
        fn: vector [P] to [M] or scalar.
        jacobian: vector to (value, Jacobian [M, P] or [P]); left out, `value_and_jacobian` of `fn`.
    """
    token = next(_tokens)
    _table[token] = (fn, jacobian or functools.partial(value_and_jacobian, fn))
    return token


def release(token: int) -> None:
    """Forget a registered function."""
    _table.pop(token, None)


def _to_words(y: jax.Array) -> list[jax.Array]:
    words = lax.bitcast_convert_type(y, np.uint32)
    return [words[i : i + PIECE] for i in range(0, len(y), PIECE)]


def _host(with_jacobian: bool, shapes: tuple[tuple[int, ...], ...], token: np.ndarray, *words: np.ndarray) -> tuple:
    y = torch.from_numpy(np.concatenate([np.asarray(part) for part in words]).view(np.float64).reshape(-1))
    fn, jacobian = _table[int(token)]
    results = jacobian(y) if with_jacobian else (fn(y),)
    out = []
    for result, shape in zip(results, shapes, strict=True):
        array = result.detach().to("cpu", torch.float64).numpy()
        if array.shape != shape:
            raise ValueError(f"bridged torch function returned shape {array.shape}, declared was {shape}")
        out.append(array.reshape(-1).copy().view(np.uint32).reshape(*shape, 2))
    return tuple(out)


def _ask_torch(
    with_jacobian: bool, shapes: tuple[tuple[int, ...], ...], y: jax.Array, token: jax.Array
) -> list[jax.Array]:
    structs = tuple(jax.ShapeDtypeStruct((*shape, 2), np.uint32) for shape in shapes)
    host = functools.partial(_host, with_jacobian, shapes)
    words = jax.pure_callback(host, structs, token, *_to_words(y), vmap_method="sequential")
    return [lax.bitcast_convert_type(word, np.float64) for word in words]


@functools.cache
def call(outputs: int | None) -> Callable[[jax.Array, jax.Array], jax.Array]:
    """The bridged call `(y [P], token) -> value`, [outputs] or a scalar where `outputs` is None.

    The function behind it is looked up at run time, so that a program compiled once serves every function of the same
    sizes.
    """
    shape = () if outputs is None else (outputs,)

    @jax.custom_jvp
    def torch_call(y: jax.Array, token: jax.Array) -> jax.Array:
        return _ask_torch(False, (shape,), y, token)[0]

    @torch_call.defjvp
    def rule(primals: tuple, tangents: tuple) -> tuple[jax.Array, jax.Array]:
        (y, token), (dy, _) = primals, tangents
        value, jacobian = _ask_torch(True, (shape, (*shape, y.shape[0])), y, token)
        return value, jacobian @ dy

    return torch_call


def bridge(
    fn: TorchFunction, outputs: int | None = None, *, jacobian: ValueAndJacobian | None = None
) -> Callable[[jax.Array], jax.Array]:
    """A torch function as a differentiable JAX function.

    Args:
        fn: float64 vector [P] to a vector [outputs], or to a scalar where `outputs` is None. Any random number it uses
            must be fixed.
        outputs: length of the result.
        jacobian: vector to (value, dense Jacobian); left out, torch.func's forward mode (reverse for a scalar).

    Returns:
        `f(y [P]) -> [outputs]` for float64 JAX arrays, to be called inside `x64()`; works under jit, vmap (one call of
        torch each), jvp, vjp, jacfwd, jacrev. The function is kept alive as long as `f` is.

    Raises:
        InputError: the argument is not a float64 vector (JAX hands over float32 outside of `x64()`).
    """
    token = register(fn, jacobian)

    def bridged(y: jax.Array) -> jax.Array:
        if y.ndim != 1 or y.dtype != np.float64:
            raise InputError(
                "y", f"{y.dtype}{list(y.shape)}", "a float64 vector (call inside `with dsfit.fit.bridge.x64()`)"
            )
        return call(outputs)(y, np.uint32(token))

    weakref.finalize(bridged, release, token)
    return bridged
