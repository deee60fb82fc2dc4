"""The clock, and both races on integrands whose variance is known."""

from __future__ import annotations

import math
import time
from typing import Any, ClassVar

import pytest
import torch
from torch import Tensor

from dsfit.context import Context
from dsfit.quadrature import gauss_legendre
from dsfit.quality import Nodes
from dsfit.race.clock import Ready, Watch, make_ready, timed
from dsfit.race.context_race import ContextPlan, predicted_variance, race_context
from dsfit.race.peer import Peer, Problem, Sampler
from dsfit.race.peers.uniform import Uniform
from dsfit.race.statistics import centred
from dsfit.race.stream_race import StreamPlan, race_stream
from dsfit.streams import ContextStream

VARIANCE = 0.8  # of sin^2 under the uniform sphere, relative to the square of its mean: (1/5) / (1/3)^2 - 1


def sin_squared(omega: Tensor, context: Context) -> Tensor:
    """Two equal channels of sin(theta_i)^2, whose integral is 4 pi / 3, times 1 + n."""
    value = torch.sin(omega[..., 0]) ** 2 * (1 + context.n)
    return value.unsqueeze(-1).expand(*value.shape, 2)


def problem(dtype: torch.dtype = torch.float64, uniforms: str = "random") -> Problem:
    return Problem(sin_squared, ContextStream(), dtype, uniforms)  # type: ignore[arg-type]


def generator(seed: int = 3) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def truth(contexts: Context) -> Tensor:
    return (4 * math.pi / 3 * (1 + contexts.n)).unsqueeze(-1).expand(-1, 2)


class Noisy(Peer):
    """Estimates truth x (1 + bias) with normal noise of relative variance `variance` / S."""

    name: ClassVar[str] = "noisy"

    def __init__(self, variance: float = 1.0, bias: float = 0.0, least: int = 1, per_context: bool = False) -> None:
        self.variance, self.bias, self.least = variance, bias, least
        self.per_context = per_context  # type: ignore[misc]
        self.asked: list[int] = []

    def prepare(self, problem: Problem) -> None:
        self.problem = problem

    def at(self, contexts: Context) -> Sampler:
        self.asked.append(len(contexts))
        return _NoisySampler(self, contexts)


class _NoisySampler(Sampler):
    def __init__(self, peer: Noisy, contexts: Context) -> None:
        self.peer, self.contexts, self.least = peer, contexts, peer.least

    def estimate(self, samples: int, generator: torch.Generator) -> Tensor:
        assert samples >= self.least
        noise = torch.randn(len(self.contexts), 1, generator=generator, dtype=torch.float64)
        return truth(self.contexts) * (1 + self.peer.bias + math.sqrt(self.peer.variance / samples) * noise)


def ready(peer: Peer, **options: Any) -> Ready:
    peer.prepare(problem(**options))
    return Ready(peer, 0.0, 0.0, 0.0, 0.0)


def test_the_clock_counts_work_and_not_waiting() -> None:
    assert timed(lambda: time.sleep(0.1))[1] < 0.08
    result, seconds = timed(lambda: sum(range(300_000)))
    assert result == 299_999 * 150_000 and 0 < seconds
    record = Watch().start().record()
    assert set(record) == {"cpu_share", "load"}


def test_preparation_counts_earlier_training_and_what_a_first_use_costs() -> None:
    class Trained(Noisy):
        recorded_seconds = 7.0
        used = False

        def at(self, contexts: Context) -> Sampler:
            if not self.used:
                end = time.process_time() + 0.05
                while time.process_time() < end:
                    pass
            self.used = True
            return super().at(contexts)

    made = make_ready(Trained(), problem(), [Context([0.1], 0.0, 1.0)], generator())
    assert made.recorded == 7.0 and made.first_use > 0.04
    assert made.seconds == pytest.approx(7.0 + made.prepare + made.first_use)


def test_at_one_context_the_measured_error_is_the_known_one_and_falls_as_the_root() -> None:
    context = Context([0.3], 0.0, 1.0)
    plan = ContextPlan(seconds=0.6, seeds=64, most_samples=4096)
    found = race_context(ready(Uniform()), context, truth(context)[0], plan, generator(), allowance=0.0)
    assert len(found["points"]) >= 4 and math.isnan(found["predicted_variance"])
    inside = 0
    for point in found["points"]:
        exact = math.sqrt(VARIANCE / point["samples"])
        assert point["rmse"]["value"] == pytest.approx(exact, rel=0.5)
        inside += point["rmse"]["low"] <= exact <= point["rmse"]["high"]
        assert point["p_value"] > 1e-4
    assert inside >= len(found["points"]) - 1
    first, last = found["points"][0], found["points"][-1]
    assert last["samples"] == first["samples"] * 4 ** (len(found["points"]) - 1)


def test_longer_estimates_are_timed_where_there_is_no_time_to_repeat_them() -> None:
    class Slow(Noisy):
        def at(self, contexts: Context) -> Sampler:
            sampler = super().at(contexts)
            quick = sampler.estimate

            def estimate(samples: int, generator: torch.Generator) -> Tensor:
                end = time.process_time() + 0.01
                while time.process_time() < end:
                    pass
                return quick(samples, generator)

            sampler.estimate = estimate  # type: ignore[method-assign]
            return sampler

    context = Context([0.3], 0.0, 1.0)
    plan = ContextPlan(seconds=0.12, seeds=64, most_samples=4**8)
    found = race_context(ready(Slow()), context, truth(context)[0], plan, generator(), allowance=0.0)
    assert len(found["points"]) == 1 and len(found["points"][0]["rmse"]) > 3
    samples = [scout["samples"] for scout in found["scouts"]]
    assert samples == [4 ** (k + 2) for k in range(7)]
    assert all(0.009 < scout["seconds"] for scout in found["scouts"])


def test_quadrature_predicts_the_variance_of_a_density() -> None:
    x, w = gauss_legendre(40)
    theta = x * math.pi / 2
    weight = w * math.pi / 2 * torch.cos(theta) * 2 * math.pi
    omega = torch.stack([theta, torch.zeros_like(theta)], dim=-1)
    context = Context([0.3], 0.0, 1.0)
    nodes = Nodes(omega, weight, sin_squared(omega, context))
    sampler = ready(Uniform()).peer.at(context)
    assert predicted_variance(sampler, nodes, truth(context)[0], torch.float64) == pytest.approx(VARIANCE, abs=1e-9)
    unknown = _NoisySampler(Noisy(), context)
    assert math.isnan(predicted_variance(unknown, nodes, truth(context)[0], torch.float64))


def test_few_samples_that_miss_what_quadrature_sees_are_not_tested() -> None:
    context = Context([0.3], 0.0, 1.0)
    x = torch.tensor([[0.1, 0.0]], dtype=torch.float64)
    spike = Nodes(x, torch.ones(1, dtype=torch.float64), torch.full((1, 2), 1e4, dtype=torch.float64))
    plan = ContextPlan(seconds=0.1, seeds=16, most_samples=64)
    found = race_context(ready(Uniform()), context, truth(context)[0], plan, generator(), allowance=0.0, nodes=spike)
    assert found["predicted_variance"] > 1e4 and not any(p["tested"] for p in found["points"])


def test_over_a_stream_the_error_is_the_root_mean_over_contexts_and_the_median_is_beside_it() -> None:
    contexts = ContextStream().draw(2000, generator())
    plan = StreamPlan(seconds=0.2, batch=300, most_samples=64)
    found, errors = race_stream(ready(Noisy(0.5)), contexts, truth(contexts), plan, generator(), allowance=0.0)
    assert found["contexts"] == found["subset"] == 2000 and errors.shape == (2000,)
    for point in found["points"]:
        exact = math.sqrt(0.5 / point["samples"])
        assert point["rmse"]["value"] == pytest.approx(exact, rel=0.1)
        assert point["median"] == pytest.approx(0.6745 * exact, rel=0.1)
    assert [p["samples"] for p in found["points"]][:3] == [1, 4, 16]


def test_a_bias_that_noise_hides_in_one_context_shows_over_the_stream() -> None:
    contexts = ContextStream().draw(1000, generator())
    plan = StreamPlan(seconds=0.05, batch=500, most_samples=4096)

    def least_p(bias: float) -> float:
        peer = ready(Noisy(1.0, bias))
        found, _ = race_stream(peer, contexts, truth(contexts), plan, generator(), allowance=1e-4)
        return min(p["p_value"] for p in found["points"] if p["tested"])

    assert least_p(0.02) < 1e-10 < 1e-4 < least_p(0.0)


def test_slow_peers_run_on_a_subset_one_by_one_and_are_scaled() -> None:
    contexts = ContextStream().draw(1000, generator())
    plan = StreamPlan(seconds=1e-6, batch=100, fewest=20, most_samples=1)
    peer = Noisy(per_context=True, least=5)
    found, errors = race_stream(ready(peer), contexts, truth(contexts), plan, generator(), allowance=0.0)
    assert found["subset"] == 20 and found["contexts"] == 1000 and len(errors) == 20
    assert set(peer.asked) == {1} and len(peer.asked) == 20
    assert found["points"][0]["samples"] == 5


def test_pieces_of_uniform_numbers_add_up_and_sobol_points_do_better() -> None:
    contexts = Context([0.1, 0.2, 0.3], 0.0, 1.0)
    pieces = list(problem(torch.float32).draw(100_000, contexts, 3, generator()))
    assert sum(len(u) for u in pieces) == 100_000 and pieces[0].shape[1:] == (3, 3) and len(pieces) > 5
    assert pieces[0].dtype == torch.float32
    errors = {}
    for kind in ("random", "sobol"):
        sampler = ready(Uniform(), uniforms=kind).peer.at(contexts)
        values = torch.cat([sampler.estimate(1024, generator(k)) for k in range(20)])
        deviation = values / truth(contexts).repeat(20, 1) - 1
        assert centred(deviation, 1e-6).p_value > 1e-4
        errors[kind] = float(deviation.square().mean().sqrt())
    assert errors["sobol"] < errors["random"] / 10
