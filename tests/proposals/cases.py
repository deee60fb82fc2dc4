"""The proposals that inherit the conformance suite. A new one needs a `Case`, here or in a `cases_*.py` beside this."""

from __future__ import annotations

import importlib
import math
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace

import torch
from torch import Tensor

from dsfit import proposals as p
from dsfit.proposals.base import Product, Proposal

DEG = math.pi / 180
Peak = tuple[float, float]
"""Centre and width, radians."""


@dataclass(frozen=True)
class Case:
    """A proposal and where its density varies fast.

    Args:
        name: shown by pytest.
        build: makes a fresh module, float64, on every call.
        theta_peaks: theta_r to the peaks in theta_i.
        phi_peaks: peaks in the relative azimuth phi.
        phi_breaks: kinks and jumps in phi, besides 0, +-pi/2 and +-pi.
        extremes: further builds, with parameters at the ends of their ranges, for the tests of finiteness.
        one_to_one: False where several pairs of uniforms give the same direction.
        n: scattering count of the contexts.
        phi_r: azimuth of the viewer.
    """

    name: str
    build: Callable[[], Proposal]
    theta_peaks: Callable[[float], list[Peak]] = lambda theta_r: []
    phi_peaks: tuple[Peak, ...] = ()
    phi_breaks: tuple[float, ...] = ()
    extremes: tuple[Callable[[], Proposal], ...] = field(default=())
    one_to_one: bool = True
    n: float = 3.0
    phi_r: float = 0.7


ALPHA = {"R": -7.5 * DEG, "TT": 3.75 * DEG, "TRT": 11.25 * DEG}
BETA = {"R": 7.5 * DEG, "TT": 3.75 * DEG, "TRT": 15 * DEG}
GAMMA = 30 * DEG
BETA_F = 5 * DEG


def fake_fiber() -> SimpleNamespace:
    """What a `Fiber` has, as far as proposals look."""
    return SimpleNamespace(
        alpha=torch.tensor(list(ALPHA.values()), dtype=torch.float64),
        beta=torch.tensor(list(BETA.values()), dtype=torch.float64),
        gamma_tt=torch.tensor(GAMMA, dtype=torch.float64),
    )


class FakeBsdf:
    """A `DualScattering` as far as proposals look; counts how often it is asked for averages."""

    def __init__(self) -> None:
        self.fiber, self.calls = fake_fiber(), 0

    def averages(self, theta_in: Tensor) -> SimpleNamespace:
        self.calls += 1
        shape = torch.tensor([0.9, 1.0, 1.1], dtype=theta_in.dtype) * torch.cos(theta_in)[..., None]
        return SimpleNamespace(beta_f=BETA_F + 0 * shape, delta_b=0.3 * shape, sigma_b=0.2 + 0.05 * shape)


def lobe_peaks(alpha: float, beta: float) -> Callable[[float], list[Peak]]:
    return lambda theta_r: [(2 * alpha - theta_r, 2 * beta)]


def uniform_phi(longitudinal: p.Longitudinal) -> Proposal:
    return Product(longitudinal, p.UniformAzimuth())


def uniform_theta(azimuthal: p.Azimuthal) -> Proposal:
    return Product(p.UniformInclination(), azimuthal)


def _sweep(make: Callable[[float], Proposal], values: tuple[float, ...]) -> tuple[Callable[[], Proposal], ...]:
    return tuple(lambda value=value: make(value) for value in values)


WIDTHS = (1e-4, 1e-3, 1.0, 10.0)
GAMMAS = (1e-3, 0.89, 0.91, 1.99, 2.01, 50.0)
FORWARD = ((math.pi, GAMMA), (-math.pi, GAMMA))


def _longitudinal() -> list[Case]:
    gauss = p.GaussianLobe
    alpha, beta = ALPHA["TRT"], BETA["TRT"]
    widened = math.sqrt(BETA["TT"] ** 2 + 3 * BETA_F**2)
    return [
        Case(
            "gaussian_lobe",
            lambda: uniform_phi(gauss(alpha, beta)),
            lobe_peaks(alpha, beta),
            extremes=_sweep(lambda w: uniform_phi(gauss(1.5 if w < 0.01 else -0.1, w)), WIDTHS),
        ),
        Case("gaussian_lobe_narrow", lambda: uniform_phi(gauss(-0.4, 1e-3)), lobe_peaks(-0.4, 1e-3)),
        Case("box_muller_lobe", lambda: uniform_phi(p.BoxMullerLobe(alpha, beta)), lobe_peaks(alpha, beta)),
        Case(
            "cauchy_lobe",
            lambda: uniform_phi(p.CauchyLobe(ALPHA["TT"], BETA["TT"])),
            lobe_peaks(ALPHA["TT"], BETA["TT"]),
            extremes=_sweep(lambda w: uniform_phi(p.CauchyLobe(1.5 if w < 0.01 else -0.1, w)), WIDTHS),
        ),
        Case("transmittance_cosine", lambda: uniform_phi(p.TransmittanceCosine())),
        Case(
            "transmittance_gaussian_diff",
            lambda: uniform_phi(p.TransmittanceGaussian(0.3, -0.1)),
            lambda theta_r: [(theta_r + 0.2, 0.6)],
            extremes=_sweep(lambda w: uniform_phi(p.TransmittanceGaussian(w)), WIDTHS),
        ),
        Case(
            "transmittance_gaussian_in",
            lambda: uniform_phi(p.TransmittanceGaussian(0.3, 0.1, variable="in")),
            lambda theta_r: [(0.1, 0.3)],
            extremes=_sweep(lambda w: uniform_phi(p.TransmittanceGaussian(w, 1.5, variable="in")), WIDTHS),
        ),
        Case(
            "scattered_lobe",
            lambda: uniform_phi(p.ScatteredLobe(ALPHA["TT"], BETA["TT"], BETA_F)),
            lobe_peaks(ALPHA["TT"], widened),
            extremes=_sweep(lambda w: uniform_phi(p.ScatteredLobe(0.1, w, 0.0)), WIDTHS),
        ),
        Case(
            "back_scatter_lobe",
            lambda: Product(p.BackScatterLobe(0.3, 0.2, 0.05), p.BackHalf()),
            lobe_peaks(0.3, 0.22),
            extremes=_sweep(lambda w: uniform_phi(p.BackScatterLobe(0.3, w)), (0.0, *WIDTHS)),
        ),
    ]


def _azimuthal() -> list[Case]:
    wrapped, truncated = p.WrappedGaussian, p.TruncatedGaussian
    cases = [
        Case("uniform_inclination", lambda: uniform_theta(p.UniformAzimuth())),
        Case("cosine_half", lambda: uniform_theta(p.CosineHalf())),
        Case("scattered_cosine", lambda: uniform_theta(p.Scattered(p.CosineHalf()))),
        Case("front_half", lambda: uniform_theta(p.FrontHalf())),
        Case("back_half", lambda: uniform_theta(p.BackHalf())),
        Case("scattered_front", lambda: uniform_theta(p.Scattered(p.FrontHalf()))),
        Case("scattered_back", lambda: uniform_theta(p.Scattered(p.BackHalf()))),
        Case("scattered_uniform", lambda: uniform_theta(p.Scattered(p.UniformAzimuth()))),
    ]
    for name, law in (("wrapped", wrapped), ("truncated", truncated)):
        for gamma in (GAMMA, 1.3, 4.0):
            label = f"{name}_gaussian_{gamma:.2f}"
            edges = ((math.pi, gamma), (-math.pi, gamma))
            extremes = _sweep(lambda g, law=law: uniform_theta(law(g)), GAMMAS) if gamma == GAMMA else ()
            turned = _sweep(lambda g, law=law: uniform_theta(p.Scattered(law(g))), GAMMAS) if gamma == GAMMA else ()
            cases.append(
                Case(
                    label,
                    lambda g=gamma, law=law: uniform_theta(law(g)),
                    phi_peaks=edges,
                    extremes=extremes,
                    one_to_one=law is truncated or gamma == GAMMA,
                )
            )
            side = tuple((sign * math.pi / 2, gamma) for sign in (1, -1))
            cases.append(
                Case(
                    f"scattered_{label}",
                    lambda g=gamma, law=law: uniform_theta(p.Scattered(law(g))),
                    phi_peaks=edges + side,
                    extremes=turned,
                )
            )
    return cases


def _whole() -> list[Case]:
    def lobe(name: str, beta_f: float | None = None) -> Proposal:
        return p.Lobe(name, ALPHA[name], BETA[name], GAMMA, beta_f=beta_f)

    def every_peak(theta_r: float) -> list[Peak]:
        return [peak for name in ALPHA for peak in lobe_peaks(ALPHA[name], BETA[name])(theta_r)]

    def mixture() -> Proposal:
        return p.Mixture([lobe("R"), lobe("TT"), lobe("TRT", BETA_F), p.FrontHemisphere()], [1.0, 2.0, 0.5, 0.5])

    cases = [
        Case("uniform_sphere", p.UniformSphere),
        Case("front_hemisphere", p.FrontHemisphere),
        Case("mixture", mixture, every_peak, (*FORWARD, (math.pi / 2, GAMMA), (-math.pi / 2, GAMMA))),
        Case("mixture_undefended", lambda: p.Mixture([lobe("R"), lobe("TT")], defensive=0.0), every_peak, FORWARD),
        Case(
            "mixture_of_mixtures",
            lambda: p.Mixture([mixture(), lobe("TT")], [0.7, 0.3]),
            every_peak,
            (*FORWARD, (math.pi / 2, GAMMA), (-math.pi / 2, GAMMA)),
        ),
    ]
    side = ((math.pi / 2, GAMMA), (-math.pi / 2, GAMMA))
    for name in ALPHA:
        widened = math.sqrt(BETA[name] ** 2 + 3 * BETA_F**2)
        cases.append(Case(f"lobe_{name}", lambda n=name: lobe(n), lobe_peaks(ALPHA[name], BETA[name]), FORWARD))
        cases.append(
            Case(
                f"lobe_{name}_scattered",
                lambda n=name: lobe(n, BETA_F),
                lobe_peaks(ALPHA[name], widened),
                FORWARD + side,
            )
        )
    return cases


def _adapted() -> list[Case]:
    dist = torch.distributions

    def f(x: float) -> Tensor:
        return torch.tensor(x, dtype=torch.float64)

    def square() -> Proposal:
        betas = dist.Independent(dist.Kumaraswamy(f(2.0).expand(2), f(3.0).expand(2)), 1)
        return p.TorchDistribution(betas, "square")

    def plane() -> Proposal:
        normal = dist.Normal(torch.zeros(2, dtype=torch.float64), torch.full((2,), 0.7, dtype=torch.float64))
        return p.TorchDistribution(dist.Independent(normal, 1), "plane")

    def angles() -> Proposal:
        low, high = torch.tensor([-1.0, -2.0]).double(), torch.tensor([0.5, 3.0]).double()
        return p.TorchDistribution(dist.Independent(dist.Uniform(low, high, validate_args=False), 1), "angles")

    kappa = 5.0

    def von_mises_fisher_log_prob(context: object, x: Tensor) -> Tensor:
        return kappa * (x[..., 1] - 1) + math.log(kappa / (2 * math.pi * -math.expm1(-2 * kappa)))

    def von_mises_fisher_sample(context: object, u: Tensor) -> Tensor:
        cosine = 1 + torch.log(u[..., 0] + (1 - u[..., 0]) * math.exp(-2 * kappa)) / kappa
        sine = torch.sqrt((1 - cosine) * (1 + cosine))
        turn = 2 * math.pi * u[..., 1]
        return torch.stack([sine * torch.cos(turn), cosine, sine * torch.sin(turn)], dim=-1)

    return [
        Case("adapter_square", square),
        Case("adapter_plane", plane),
        Case("adapter_angles", angles, lambda theta_r: [(-1.0, 1e-3), (0.5, 1e-3)], phi_breaks=(-2.0, 3.0)),
        Case(
            "adapter_vector",
            lambda: p.FromDensity(von_mises_fisher_log_prob, von_mises_fisher_sample, space="vector"),
            phi_r=-2.5,
        ),
    ]


def all_cases() -> list[Case]:
    """The cases of this file, then `CASES` of every `cases_*.py` beside it."""
    found = [*_longitudinal(), *_azimuthal(), *_whole(), *_adapted()]
    for path in sorted(Path(__file__).parent.glob("cases_*.py")):
        found += importlib.import_module(f"tests.proposals.{path.stem}").CASES
    return found
