"""The compiled functions against the eager ones."""

from __future__ import annotations

import copy

import pytest
import torch

from dsfit.errors import InputError
from dsfit.kernels import compiler, native
from tests.kernels import cases

pytestmark = pytest.mark.skipif(not cases.has_compiler(), reason="no C++ compiler")
# one context, one direction each, few and many, blocks that are full and not
SHAPES = ((1, 1), (40, 1), (3, 5), (1, 37), (4, 50), (9, 31))


def _agree(preset: str, v: float | None, shapes: tuple[tuple[int, int], ...]) -> None:
    eager, compiled = cases.kernel(preset), cases.kernel(preset, "compiled")
    for samples, batch in shapes:
        contexts = eager.prepare_context(cases.contexts(batch, v=v))
        u = cases.uniforms(samples, batch)
        wanted, found = eager.sample_eval(contexts, u), compiled.sample_eval(contexts, u)
        for a, b in zip(wanted, found, strict=True):
            assert a.shape == b.shape
            close = (a - b).abs() <= 1e-4 * a.abs() + 1e-5
            assert float(close.double().mean()) > 0.999  # a uniform may sit on the edge of a component
        theta_i, phi = wanted[:2]
        value, density = compiled.eval(contexts, theta_i, phi), compiled.log_prob(contexts, theta_i, phi)
        assert torch.allclose(value, wanted[3], rtol=3e-4, atol=1e-6)
        assert torch.allclose(density, torch.log(wanted[2]), rtol=0, atol=1e-3)
        again = compiled.sample_eval(contexts, u)
        assert all(torch.equal(a, b) for a, b in zip(found, again, strict=True))
        assert torch.equal(compiled.eval(contexts, *found[:2]), found[3])
        assert all(torch.equal(a, b) for a, b in zip(compiled.sample(contexts, u), found[:2], strict=True))


def test_compiled_and_eager_agree() -> None:
    _agree("blond", None, SHAPES)


@pytest.mark.slow
@pytest.mark.parametrize("v", [0.0, 1.0])
@pytest.mark.parametrize("preset", ["blond", "black"])
def test_compiled_and_eager_agree_on_either_half(preset: str, v: float) -> None:
    _agree(preset, v, SHAPES)


def test_without_a_compiler_kernels_are_eager_and_say_why(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(compiler.shutil, "which", lambda name: None)
    monkeypatch.delenv("CXX", raising=False)
    native.library.cache_clear()
    kernel = copy.copy(cases.kernel())  # the same tables, as if made with mode="auto" and then "compiled"
    kernel.backend, kernel._mode, kernel._programs = "compiled", "auto", {}
    contexts, u = kernel.prepare(0.2, 1.0, 0.5), cases.uniforms(3, 1)
    assert kernel.backend.startswith("eager: no C++ compiler")
    assert torch.equal(kernel.sample(contexts, u)[0], cases.kernel().sample(contexts, u)[0])
    kernel.backend, kernel._mode, kernel._programs = "compiled", "compiled", {}
    with pytest.raises(InputError, match="compiler"):
        kernel.prepare(0.2, 1.0, 0.5)


def test_a_compiler_that_fails_is_reported(monkeypatch: pytest.MonkeyPatch, tmp_path) -> None:  # noqa: ANN001
    monkeypatch.setenv("CXX", "false")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    native.library.cache_clear()
    with pytest.raises(native.NoCompiler, match="false failed"):
        native.library(cases.kernel().program("both").layout)
