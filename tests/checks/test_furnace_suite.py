"""The suite on a scene: everything passes, every control is rejected, a user's wrong sampler is caught."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

import dsfit
from dsfit.checks import furnace
from dsfit.checks.finding import judge
from dsfit.checks.furnace.sampling import furnace_case, judge_proposal, proposal_findings
from dsfit.checks.subject import Outcome
from dsfit.experiment.check_schema import FurnaceOptions
from dsfit.experiment.plots.checks.furnace import figures
from dsfit.experiment.plots.style import styled
from dsfit.proposals import Lobe, UniformSphere
from dsfit.proposals.base import Proposal
from dsfit.scene import SlabScattering


@pytest.fixture(scope="module")
def outcome() -> Outcome:
    """Blond, one channel, under a light that the suite has to replace."""
    from dsfit.scene import VonMisesFisherLights

    bsdf = dsfit.DualScattering(dsfit.Fiber.preset("blond", sigma_a=[0.07]), precision="table")
    light = VonMisesFisherLights([[0.3, 0.2]], [0.2], [1.0])
    said: list[str] = []
    found = furnace.run(dsfit.Integrand(bsdf, light), seed=3, say=said.append, inclinations_deg=[20.0, -89.9],
                        n=[2.0], samples=4000, rings=18, wedges=6)  # fmt: skip
    assert len(said) >= 4
    return found


def test_everything_passes_and_controls_are_rejected(outcome: Outcome) -> None:
    judged = judge(outcome.findings)
    assert not [(f.subject, f.case, f.detail) for f, verdict in judged if verdict != "pass"]
    subjects = {f.subject.split(":")[0] for f, _ in judged}
    assert {"white furnace", "ring light", "azimuthal wedges", "single samples", "material", "control"} <= subjects
    assert sum(f.subject.startswith("control") for f in outcome.findings) >= 16
    assert all(f.p_value is not None or f.bound is not None or "information" in f.detail for f in outcome.findings)


def test_arrays_and_figures(outcome: Outcome) -> None:
    arrays = outcome.arrays
    names, cases = list(arrays["proposal_names"]), len(arrays["labels"])
    assert arrays["proposal_ring_sampled"].shape == (cases, len(names), 18)
    assert arrays["control_ring_sampled"].shape[2] == 18 and np.isfinite(arrays["value"]).all()

    class Directory:
        def arrays(self, index: int) -> dict[str, np.ndarray]:
            return arrays

    cells = [{"suite": "furnace", "index": 0, "label": "blond"}, {"suite": "gradients", "index": 1, "label": "blond"}]
    with styled():
        drawn = dict(figures(Directory(), {"cells": cells}))  # type: ignore[arg-type]
    assert set(drawn) == {"furnace-0000", "rings-0000"}
    assert len(drawn["rings-0000"].axes) >= 8


def test_options_are_those_of_the_config() -> None:
    import inspect

    parameters = inspect.signature(furnace.run).parameters
    options = FurnaceOptions().model_dump()
    assert {name: parameters[name].default for name in options} == {
        k: tuple(v) if isinstance(v, list) else v for k, v in options.items()
    }


class WrongLobe(Lobe):
    """A user's sampler: the right lobe for a viewer on the other side."""

    def forward(self, context: dsfit.Context):  # noqa: ANN201
        right, other = super().forward(context), super().forward(dsfit.Context(-context.theta_r, context.phi_r))
        right.sample_with_log_prob = lambda u: (other.sample(u), right.log_prob(other.sample(u)))
        return right


def test_a_users_sampler_is_caught() -> None:
    fiber = dsfit.Fiber.preset("blond", sigma_a=[0.07])
    integrand, context = dsfit.Integrand(dsfit.DualScattering(fiber, d_b=0.0)), dsfit.Context(0.3, 0.7)
    case = furnace_case(integrand, context, "test", furnace.Partition.even(18, 6))

    def verdicts(proposal: Proposal) -> dict[str, str]:
        tested = judge_proposal(integrand, case, proposal, 6000, torch.Generator().manual_seed(2))
        found = proposal_findings("mine", case, tested)
        return {f.subject.split(":")[0]: f.verdict(1e-6 if f.p_value is not None else 0.01) for f in found}

    right = (fiber.alpha[1], fiber.beta[1], fiber.gamma_tt)
    assert set(verdicts(Lobe("TT", *right, learnable=False)).values()) == {"pass"}
    assert verdicts(WrongLobe("TT", *right, learnable=False))["ring light"] == "fail"
    assert set(verdicts(UniformSphere()).values()) == {"pass"}


def test_scenes_with_their_own_scattering_keep_it() -> None:
    bsdf = dsfit.DualScattering(dsfit.Fiber.preset("blond", sigma_a=[0.07]), precision="table")
    slab = SlabScattering(2.0, 0.5, 3.0)
    scene = dsfit.Integrand(bsdf, scattering=slab)
    (_, context), *others = furnace._contexts(scene, [30.0], [0.0, 3.0])
    assert not others and float(context.n) > 0
    assert float(context.theta_r) == pytest.approx(math.radians(30))
