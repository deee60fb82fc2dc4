"""The bijections: round trips, slopes, bounds, errors."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from dsfit.context import Context
from dsfit.errors import InputError
from dsfit.proposals import GaussianLobe
from dsfit.proposals.parameters import AZIMUTH_STD_BOUNDS, STD_BOUNDS, Bounded, Given, from_raw, to_raw


@given(st.floats(-4.9, 4.9), st.floats(-1.55, 1.55))
def test_round_trip(log_width: float, centre: float) -> None:
    for value, low, high, log in ((math.exp(log_width), *STD_BOUNDS, True), (centre, -1.57, 1.57, False)):
        if not low < value < high:
            continue
        raw = to_raw("x", torch.tensor(value, dtype=torch.float64), low, high, log)
        assert from_raw(raw, low, high, log).item() == pytest.approx(value, rel=1e-12, abs=1e-12)


def test_a_unit_of_raw_is_a_unit_of_value_at_the_centre() -> None:
    raw = torch.tensor(0.0, dtype=torch.float64, requires_grad=True)
    linear, width = from_raw(raw, -1.5, 1.5), from_raw(raw, *STD_BOUNDS, log=True)
    assert torch.autograd.grad(linear, raw)[0].item() == pytest.approx(1)
    assert torch.autograd.grad(torch.log(width), raw)[0].item() == pytest.approx(1)


def test_no_raw_number_leaves_the_bounds() -> None:
    raw = torch.tensor([-1e6, -50.0, 0.0, 50.0, 1e6], dtype=torch.float64)
    for low, high, log in ((*STD_BOUNDS, True), (*AZIMUTH_STD_BOUNDS, True), (-1.5, 1.5, False)):
        value = from_raw(raw, low, high, log)
        slack = 1e-12 * max(abs(low), abs(high)) if not log else 1e-12 * low
        assert bool((value >= low - slack).all()) and bool((value <= high * (1 + 1e-12)).all())


def test_errors_name_the_field() -> None:
    for value in (0.0, 1e-5, 100.0, math.inf, math.nan):
        with pytest.raises(InputError, match="width"):
            Bounded("width", value, *STD_BOUNDS, log=True)
    with pytest.raises(InputError, match="beta_f"):
        Given("beta_f", math.nan)


def test_shapes_dtypes_and_devices() -> None:
    lobe = GaussianLobe(torch.tensor([0.1, -0.2]), 0.3)
    assert lobe.mean.raw.dtype == torch.float32 and lobe.std.raw.dtype == torch.float64
    law = lobe(Context([0.0, 0.5], dtype=torch.float64))
    assert law.mean.dtype == torch.float64 and law.mean.shape == (2,)
    assert lobe(Context([0.0, 0.5], dtype=torch.float32)).std.dtype == torch.float32
    fixed = GaussianLobe(0.1, 0.3, learnable=False)
    assert not list(fixed.parameters()) and not fixed.constrained() and len(fixed.state_dict()) == 2


def test_numbers_keep_double_precision() -> None:
    assert GaussianLobe(0.1, 0.3).mean().item() == pytest.approx(0.1, rel=1e-14)
    assert Given("x", 0.1)(Context(0.0, dtype=torch.float64)).item() == 0.1


def test_given_is_detached_and_may_follow_the_context() -> None:
    slope = torch.tensor(2.0, requires_grad=True)
    value = Given("x", lambda context: slope * context.theta_r)(Context([0.5], dtype=torch.float64))
    assert not value.requires_grad and value.dtype == torch.float64
    assert value.item() == pytest.approx(1.0)
