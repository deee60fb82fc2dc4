"""Contexts that compiled code prepares, and `shade`, which prepares, draws and evaluates at once."""

from __future__ import annotations

import copy
import math

import pytest
import torch
from torch import Tensor

from dsfit.errors import InputError
from dsfit.kernels import Contexts
from dsfit.kernels.contexts import mixture_fields
from dsfit.kernels.hair import _Plain
from dsfit.kernels.layout import FIELDS
from dsfit.proposals import AmortisedProposal
from dsfit.proposals.amortised import MixtureShape
from tests.kernels import cases

pytestmark = pytest.mark.skipif(not cases.has_compiler(), reason="no C++ compiler")
SIZES = (1, 2, 15, 16, 17, 31, 33, 70)


def numbers(count: int, v: float | None = None) -> tuple[Tensor, Tensor, Tensor]:
    context = cases.contexts(count, v=v)
    return context.theta_r, context.n, context.v


def corners() -> tuple[Tensor, Tensor, Tensor]:
    """Grazing views, no and very many fibres, shares of (nearly) nothing."""
    end = math.radians(89.999)
    theta_r = torch.tensor([-math.pi / 2, -end, -1.5, 0.0, 0.3, 1.2, end])
    n, v = torch.tensor([0.0, 1e-3, 0.25, 1.0, 7.0, 100.0, 1e4]), torch.tensor([0.0, 1e-7, 0.3, 1 - 6e-8, 1.0])
    return tuple(x.flatten() for x in torch.meshgrid(theta_r, n, v, indexing="ij"))


def exact_fields(preset: str, c: Contexts) -> tuple[Tensor, Tensor]:
    """Fields in float64 at the same float32 numbers, and the weights `[K, B]`."""
    which = cases.kernel(preset).program(c.need).components
    shape = cases.mixture(preset).shape(_Plain(c.theta_r.double(), c.n.double(), c.v.double()))
    given = (shape.log_weights, shape.mode, shape.below, shape.above)
    return mixture_fields(c.theta_r.double(), given, which), torch.exp(shape.log_weights[:, which].t())


def errors(preset: str, c: Contexts) -> dict[str, float]:
    """Largest error of each field over components with a weight beyond 1e-6, relative to what exceeds 0.01 (and 1 for
    logarithms)."""
    wanted, weight = exact_fields(preset, c)
    seen, found = weight > 1e-6, {}
    for k, name in enumerate(FIELDS):
        least = 1.0 if name == "log_scale" else 0.01
        error = (c.fields[k] - wanted[k]).abs() / wanted[k].abs().clamp_min(least)
        found[name] = float(error[seen].max())
    return found


@pytest.mark.parametrize("v", [None, 0.0, 1.0])
@pytest.mark.parametrize("preset", ["blond", pytest.param("black", marks=pytest.mark.slow)])
def test_prepared_contexts_agree_with_the_proposal(preset: str, v: float | None) -> None:
    """Tails have the rounding of their arguments times the square of these."""
    given = numbers(1500, v)
    found, eager = (cases.kernel(preset, mode).prepare(*given) for mode in ("compiled", "eager"))
    assert found.need == eager.need and found.fields.shape == eager.fields.shape
    for name, error in errors(preset, found).items():
        assert error < (2e-4 if name in ("left", "far_left", "far_right") else 3e-5), name
        assert error < 4 * errors(preset, eager)[name] + 1e-6, name


def test_extremes_agree_with_the_proposal() -> None:
    """Log energies of many fibres are thousands, and float32 keeps four decimals of them: compiled and eager forms
    differ from float64 by the same."""
    given = corners()
    found, eager = (cases.kernel(mode=mode).prepare(*given) for mode in ("compiled", "eager"))
    assert bool(torch.isfinite(found.fields).all())
    for name, error in errors("blond", eager).items():
        assert error < 1e-2 and errors("blond", found)[name] < 1.5 * error + 2e-5, name
    few = given[1] < 50
    for name, error in errors("blond", cases.kernel(mode="compiled").prepare(*(x[few] for x in given))).items():
        assert error < 3e-4, name


def test_shares_of_zero_are_zero() -> None:
    theta_r, n, v = corners()
    kernel = cases.kernel(mode="compiled")
    edge = kernel.prepare(theta_r, n, v).fields[FIELDS.index("edge")]
    weight = torch.diff(edge, dim=0, prepend=torch.zeros(1, len(v)))
    names = [kernel.mixture.names[k] for k in kernel.program("both").components]
    scattered = torch.tensor(["scattered" in name for name in names])
    assert float(weight[scattered][:, v == 1].abs().max()) == 0
    assert float(weight[[0, 1, 2]][:, v == 0].abs().max()) == 0
    assert torch.allclose(edge[-1], torch.tensor(1 - kernel.mixture.defensive), atol=1e-6)


def test_any_number_of_contexts_is_prepared_alike() -> None:
    kernel, given = cases.kernel(mode="compiled"), numbers(70, 0.3)
    whole = kernel.prepare(*given).fields
    for size in SIZES:
        assert torch.equal(kernel.prepare(*(x[:size] for x in given)).fields, whole[..., :size])
    for mode in ("compiled", "eager"):
        assert cases.kernel(mode=mode).prepare(*(x[:0] for x in given)).fields.shape == (*whole.shape[:2], 0)


def test_numbers_in_another_form_are_prepared_alike() -> None:
    kernel, (theta_r, n, v) = cases.kernel(mode="compiled"), numbers(20, 0.3)
    whole = kernel.prepare(theta_r, n, v).fields
    assert torch.equal(kernel.prepare(theta_r.double(), n, 0.3).fields, whole)
    assert torch.equal(kernel.prepare(theta_r.repeat_interleave(2)[::2], n.tolist(), v).fields, whole)
    wrong = v.clone()
    for value in (-0.1, 1.1, math.nan):
        wrong[7] = value
        with pytest.raises(InputError, match="context.v"):
            kernel.prepare(theta_r, n, wrong)
        with pytest.raises(InputError, match="context.v"):
            kernel.shade(theta_r, n, wrong, cases.uniforms(2, 20))
    with pytest.raises(InputError, match="context.n"):
        kernel.prepare(theta_r, torch.full_like(n, math.inf), v)


@pytest.mark.parametrize("mode", ["compiled", "eager"])
@pytest.mark.parametrize(("samples", "batch"), [(1, 1), (3, 5), (1, 37), (4, 50)])
def test_shade_is_sample_eval_of_what_it_prepares(mode: str, samples: int, batch: int) -> None:
    kernel, given, u = cases.kernel(mode=mode), numbers(batch), cases.uniforms(samples, batch)
    found = kernel.shade(*given, u)
    assert [x.shape for x in found] == [(samples, batch)] * 3 + [(samples, batch, 3)]
    theta_r, n, v = given
    kinds = (v == 1, v == 0, (v > 0) & (v < 1))
    for kind in kinds if mode == "compiled" else (torch.ones_like(v, dtype=torch.bool),):
        if bool(kind.any()):
            wanted = kernel.sample_eval(kernel.prepare(theta_r[kind], n[kind], v[kind]), u[:, kind].contiguous())
            for a, b in zip(found, wanted, strict=True):
                assert torch.allclose(a[:, kind], b, rtol=1e-5, atol=1e-6)


def test_shade_refuses_other_uniforms() -> None:
    kernel, given = cases.kernel(mode="compiled"), numbers(4)
    for u in (torch.rand(2, 5, 3), torch.rand(4, 3), torch.rand(0, 4, 3), torch.rand(2, 4, 3).double()):
        with pytest.raises(InputError, match="u"):
            kernel.shade(*given, u)


class _Shifted(AmortisedProposal):
    """A proposal with a shape of its own."""

    def shape(self, context) -> MixtureShape:  # noqa: ANN001
        shape = super().shape(context)
        return MixtureShape(shape.log_weights, shape.mode + 0.1, shape.below, shape.above)


def test_other_proposals_are_prepared_by_their_own_shape() -> None:
    kernel, given = copy.copy(cases.kernel(mode="compiled")), numbers(20)
    kernel.snapshot, kernel._programs = copy.copy(kernel.snapshot), {}
    kernel.snapshot.__class__ = _Shifted
    assert kernel.program("both").start is None
    moved, plain = kernel.prepare(*given).fields, cases.kernel(mode="compiled").prepare(*given).fields
    assert not torch.allclose(moved[0], plain[0], atol=0.05)
    few = kernel.prepare(*(x[:3] for x in given))
    assert torch.equal(few.fields, kernel.prepare(*given).fields[..., :3])
    assert all(bool(torch.isfinite(x).all()) for x in kernel.shade(*given, cases.uniforms(2, 20)))
