"""The peers of this library: each estimates the right thing, and the registry knows them."""

from __future__ import annotations

from typing import Any

import pytest
import torch

import dsfit
from dsfit.errors import InputError
from dsfit.race import registry
from dsfit.race.peer import Peer, Problem
from dsfit.race.references import StreamReference
from dsfit.race.statistics import centred
from dsfit.streams import ContextStream

OWN = ("uniform", "single", "chapter", "best_mix", "stream_mix", "structured", "fitted", "amortised", "kernel")
FEW = ["TT", "back", "uniform"]
CASES: dict[str, tuple[str, dict[str, Any], int]] = {
    "uniform": ("uniform", {}, 3072),
    "one lobe, defensive": ("single", {"proposal": "back", "defensive": 0.3}, 4096),
    "balance": ("chapter", {}, 560),
    "power": ("chapter", {"heuristic": "power", "proposals": FEW}, 2048),
    "cutoff": ("chapter", {"heuristic": "cutoff", "proposals": FEW}, 2048),
    "maximum, one sample": ("chapter", {"heuristic": "maximum", "model": "one", "proposals": FEW}, 4096),
    "balance, one sample": ("chapter", {"model": "one"}, 1024),
    "optimal": ("chapter", {"heuristic": "optimal", "proposals": FEW}, 2048),
    "mix of the stream": ("stream_mix", {"contexts": 2}, 2048),
    "structured": ("structured", {}, 64),
    "amortised, untrained": ("amortised", {"train": False}, 64),
}
SLOW: dict[str, tuple[str, dict[str, Any], int]] = {
    "best mix": ("best_mix", {}, 280),
    "fitted": ("fitted", {"max_steps": 3}, 64),
    "amortised": ("amortised", {"training": {"steps": 30, "inclinations": 16, "pairs": 4}}, 64),
}
REPEATS = 24


@pytest.fixture(scope="module")
def scene() -> tuple[dsfit.Integrand, StreamReference]:
    fiber = dsfit.Fiber.preset("blond", eccentricity=1.0)
    integrand = dsfit.Integrand(dsfit.DualScattering(fiber, azimuthal="simplified", precision="table"))
    return integrand, StreamReference(integrand)


def estimates_are_centred(
    scene: tuple[dsfit.Integrand, StreamReference], kind: str, options: dict[str, Any], samples: int,
    uniforms: str = "random",
) -> None:  # fmt: skip
    """Repeated estimates at a lit and at an unlit context scatter around the truth."""
    integrand, reference = scene
    stream = ContextStream(rule="mixed")
    peer = registry.make(kind, options)
    peer.prepare(Problem(integrand, stream, torch.float32, uniforms, exact=integrand))
    contexts = dsfit.Context([0.3, -0.9], 0.0, [0.0, 4.0], dtype=torch.float32)
    truth = reference(contexts)
    generator = torch.Generator().manual_seed(5)
    repeats, batch = (REPEATS, 1) if peer.per_context else (1, REPEATS)
    with torch.no_grad():
        sampler = peer.at(contexts[torch.arange(2).repeat(batch)])
        values = torch.cat([sampler.estimate(samples, generator) for _ in range(repeats)]).reshape(REPEATS, 2, 3)
        density = sampler.log_prob(torch.rand(7, 2 * batch, 2) - 0.5)
    assert density is None or density.shape == (7, 2 * batch)
    for k in range(2):
        test = centred((values[:, k] - truth[k]) / truth[k].norm(), 1e-4)
        assert test.p_value > 1e-5 and (test.tested or test.bias < 2e-3), (k, test)


@pytest.mark.parametrize("case", CASES)
def test_estimates_scatter_around_the_truth(scene: Any, case: str) -> None:
    estimates_are_centred(scene, *CASES[case])


@pytest.mark.parametrize("case", ["uniform", "balance", "structured"])
def test_so_do_those_on_sobol_points(scene: Any, case: str) -> None:
    kind, options, samples = CASES[case]
    estimates_are_centred(scene, kind, options, samples, "sobol")


@pytest.mark.slow
@pytest.mark.parametrize("case", SLOW)
def test_so_do_those_of_peers_that_are_fitted(scene: Any, case: str) -> None:
    estimates_are_centred(scene, *SLOW[case])


@pytest.mark.slow
def test_peers_of_one_process_train_once_and_each_counts_the_time(scene: Any) -> None:
    problem = Problem(scene[0], ContextStream(), exact=scene[0])
    options = {"training": {"steps": 2, "inclinations": 8, "pairs": 2}}
    first, second = registry.make("amortised", options), registry.make("amortised", options)
    first.prepare(problem)
    second.prepare(problem)
    assert first.recorded_seconds == 0 and second.recorded_seconds > 0  # the first is timed while it trains


def test_a_loaded_proposal_brings_the_seconds_of_its_training(scene: Any, tmp_path: Any) -> None:
    from dsfit.proposals.amortised import AmortisedProposal

    proposal = AmortisedProposal(scene[0].bsdf).requires_grad_(False)
    dsfit.save_proposal(tmp_path / "trained.npz", proposal)
    peer = registry.make("amortised", {"file": str(tmp_path / "trained.npz"), "file_seconds": 12.5})
    peer.prepare(Problem(scene[0], ContextStream(), exact=scene[0]))
    assert peer.recorded_seconds == 12.5
    context = dsfit.Context([0.2], 0.0, 2.0)
    omega = torch.rand(5, 1, 2, dtype=torch.float64)
    assert torch.equal(peer.at(context).log_prob(omega), proposal(context).log_prob(omega))
    with pytest.raises(InputError, match="file_seconds"):
        registry.make("amortised", {"file": "trained.npz"})


def test_the_registry_finds_every_peer_by_its_name() -> None:
    for kind in OWN:
        cls = registry.peer_class(kind)
        assert issubclass(cls, Peer) and cls.name == kind and registry.PEERS[kind].about
    assert registry.missing("uniform") == []


@pytest.mark.parametrize(
    "kind, options, field",
    [
        ("unifrom", {}, "peer"),
        ("uniform", {"samples": 3}, "uniform.samples"),
        ("chapter", {"heuristic": "best"}, "chapter.heuristic"),
        ("chapter", {"model": "two"}, "chapter.model"),
        ("chapter", {"proposals": []}, "chapter.proposals"),
        ("single", {"defensive": 1.0}, "single.defensive"),
        ("structured", {"defensive": 0.0}, "structured.defensive"),
        ("fitted", {"max_steps": 0}, "fitted.max_steps"),
        ("stream_mix", {"contexts": 0}, "stream_mix.contexts"),
    ],
)
def test_unknown_peers_and_options_are_refused(kind: str, options: dict[str, Any], field: str) -> None:
    with pytest.raises(InputError) as caught:
        registry.make(kind, options)
    assert caught.value.field == field


def test_unknown_proposals_are_refused_when_they_are_prepared(scene: Any) -> None:
    with pytest.raises(InputError, match="M_R"):
        registry.make("single", {"proposal": "M_X"}).prepare(Problem(scene[0], ContextStream(), exact=scene[0]))


@pytest.mark.slow
def test_kernels_estimate_the_same_and_the_race_gives_their_integrand_to_all() -> None:
    from dsfit.race.implementation import make_integrand

    fiber = dsfit.Fiber.preset("blond", eccentricity=1.0)
    exact = dsfit.Integrand(dsfit.DualScattering(fiber, precision="table"))
    integrand, facts = make_integrand(exact, "auto", torch.float32)
    context = dsfit.Context([0.3, -0.9], 0.0, [0.0, 4.0], dtype=torch.float32)
    omega = torch.rand(50, 2, 2) - 0.5
    close = exact(omega.double(), context.to(torch.float64))
    assert torch.allclose(integrand(omega, context).double(), close, rtol=0.02)
    if facts["implementation"] == "compiled":
        assert integrand is not exact and facts["compile_seconds"] >= 0
    estimates_are_centred((exact, StreamReference(exact)), "kernel", {"train": False}, 256)


def test_implementations_that_do_not_go_with_float64_are_refused(scene: Any) -> None:
    from dsfit.race.implementation import make_integrand

    assert make_integrand(scene[0], "auto", torch.float64)[0] is scene[0]
    assert make_integrand(scene[0], "eager", torch.float32)[1]["implementation"] == "eager"
    with pytest.raises(InputError, match="float64"):
        make_integrand(scene[0], "compiled", torch.float64)
