"""The torch-to-JAX bridge against pure JAX: values, both modes, jit, vmap; float64 and liveness in every thread."""

from __future__ import annotations

import os
import subprocess
import sys

import numpy as np
import pytest
import torch

pytest.importorskip("jax")
import jax
import jax.numpy as jnp

from dsfit.errors import InputError
from dsfit.fit.bridge import _table, bridge, x64

P, M = 3, 5
A = np.random.default_rng(0).normal(size=(M, P))


def torch_residuals(y):
    return torch.sin(torch.from_numpy(A) @ y) + y[0] * y[1]


def jax_residuals(y):
    return jnp.sin(jnp.asarray(A) @ y) + y[0] * y[1]


def torch_scalar(y):
    return torch_residuals(y).square().sum()


def jax_scalar(y):
    return jnp.square(jax_residuals(y)).sum()


@pytest.fixture(autouse=True)
def double():
    with x64():
        yield


def close(a, b):
    np.testing.assert_allclose(np.asarray(a), np.asarray(b), rtol=1e-13, atol=1e-14)


Y = np.array([0.3, -1.1, 0.7])
DY = np.array([1.0, 2.0, -0.5])


@pytest.mark.parametrize("jit", [False, True])
@pytest.mark.parametrize(
    "fn, ref, outputs",
    [(torch_residuals, jax_residuals, M), (torch_scalar, jax_scalar, None)],
    ids=["vector", "scalar"],
)
def test_transforms_agree_with_jax(fn, ref, outputs, jit):
    wrap = jax.jit if jit else (lambda f: f)
    f, y, dy = bridge(fn, outputs), jnp.asarray(Y), jnp.asarray(DY)
    close(wrap(f)(y), ref(y))
    for ours, theirs in zip(wrap(lambda y, dy: jax.jvp(f, (y,), (dy,)))(y, dy), jax.jvp(ref, (y,), (dy,)), strict=True):
        close(ours, theirs)
    cotangent = jnp.arange(1.0, M + 1) if outputs else jnp.asarray(2.0)
    close(wrap(lambda y, c: jax.vjp(f, y)[1](c)[0])(y, cotangent), jax.vjp(ref, y)[1](cotangent)[0])
    close(wrap(jax.jacfwd(f))(y), jax.jacfwd(ref)(y))
    close(wrap(jax.jacrev(f))(y), jax.jacrev(ref)(y))
    batch = jnp.stack([y, 2 * y, y - 1])
    close(wrap(jax.vmap(f))(batch), jax.vmap(ref)(batch))
    close(wrap(jax.vmap(jax.jacfwd(f)))(batch), jax.vmap(jax.jacfwd(ref))(batch))
    close(wrap(jax.vmap(jax.jacrev(f)))(batch), jax.vmap(jax.jacrev(ref))(batch))


def test_inside_a_loop_and_composed_with_jax():
    f = bridge(torch_residuals, M)

    def program(f, y):
        return jax.lax.fori_loop(0, 4, lambda i, y: y - 0.1 * jnp.asarray(A).T @ f(y), y)

    close(jax.jit(lambda y: program(f, y))(jnp.asarray(Y)), program(jax_residuals, jnp.asarray(Y)))
    close(
        jax.jacfwd(lambda y: program(f, y))(jnp.asarray(Y)),
        jax.jacfwd(lambda y: program(jax_residuals, y))(jnp.asarray(Y)),
    )


def test_linearize_asks_torch_once():
    calls = []

    def jacobian(y):
        calls.append(1)
        return torch_residuals(y), torch.from_numpy(A) * torch.cos(torch.from_numpy(A) @ y)[:, None]

    def plain(y):
        raise AssertionError("the value must come with the Jacobian")

    f = bridge(plain, M, jacobian=jacobian)
    jax.block_until_ready(jax.jit(lambda y: jax.vmap(jax.linearize(f, y)[1])(jnp.eye(P)))(jnp.asarray(Y)))
    assert len(calls) == 1


def test_float32_is_refused_and_flag_untouched():
    with jax.enable_x64(False):
        with pytest.raises(InputError, match="x64"):
            bridge(torch_scalar)(jnp.asarray(Y))
        assert not jax.config.jax_enable_x64


def test_wrong_shape_is_an_error():
    with pytest.raises(Exception, match="declared"):
        jax.block_until_ready(bridge(torch_residuals, M + 1)(jnp.asarray(Y)))


def test_functions_are_released():
    before = len(_table)
    f = bridge(torch_scalar)
    assert len(_table) == before + 1
    del f
    assert len(_table) == before


LARGE = """
import numpy as np, torch, jax, jax.numpy as jnp
from dsfit.fit.bridge import bridge, x64
n = 300_000

def fn(y):
    m = torch.ones(300, 300, dtype=torch.float64)
    return torch.sin(2 * y) + 0 * (m @ m).sum()

with x64():
    f = bridge(fn, n)
    y = jnp.linspace(0, 1, n)
    # a chain of calls, and independent ones that JAX may run on several threads at once
    chain = jax.jit(lambda y: jax.lax.fori_loop(0, 3, lambda i, c: f(c) + 1e-3 * jnp.cos(c), y))
    a = jnp.ones((500, 500))
    wide = jax.jit(lambda a, y: f(y + 0 * (a @ a).sum()) + f(y + 1) + f(y + 2))
    out = [wide(a, y) for _ in range(4)]
    ref = y
    for _ in range(3):
        ref = jnp.sin(2 * ref) + 1e-3 * jnp.cos(ref)
    np.testing.assert_allclose(chain(y), ref, rtol=1e-13)
    three = jnp.sin(2 * y) + jnp.sin(2 * y + 2) + jnp.sin(2 * y + 4)
    np.testing.assert_allclose(out[-1], three, rtol=1e-12, atol=1e-14)
print("done")
"""


@pytest.mark.parametrize("one_core", [False, True])
def test_large_arrays_neither_deadlock_nor_lose_precision(one_core):
    # In a process of its own: a deadlock must fail the test, not hang the suite.
    code = ("import os; os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})\n" if one_core else "") + LARGE
    env = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=50, env=env)
    assert done.stdout.strip() == "done", done.stderr[-2000:]
