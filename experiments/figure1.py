"""The chapter's figure 1: average forward and backward attenuation a_f, a_b over inclination for the presets, what
a_f^n makes of it, and how the chapter's cos(theta) / 2 (33) and a fitted Gaussian stand for that."""

from __future__ import annotations

import math
from typing import Annotated, Any, Literal

import numpy as np
import torch
from pydantic import Field
from torch import Tensor

from dsfit import Convention, DualScattering, Fiber
from dsfit.figures import Close, Data, Experiment, Settings, Work
from dsfit.fit import TransmittanceFit, fit_transmittance
from dsfit.frame import HALF_PI
from dsfit.special import truncated_normal_log_prob
from experiments._figure1_claims import claims_of

_DEG = 180 / math.pi
_NEAR = 5.0  # degrees around the peak that its curvature is taken from
_ANGLES = ("mean", "std", "centre", "width", "width_centred")
_EXCESSES = ("excess", "excess_centred", "excess_cosine")
Numbers = Annotated[list[Annotated[float, Field(ge=0, le=1e5)]], Field(min_length=2)]
Power = Annotated[float, Field(ge=0, le=2)]
Preset = Literal["nonabsorbing", "blond", "brown", "black"]


class Figure1(Settings):
    """Angles in degrees.

    `presets` are the fibres, the first one what the others are compared with; `step_deg` is the distance of
    inclinations; `shown_n` are the n whose densities are drawn, `fit_n` those that are fitted; `cosines` is the power
    of cos(theta) beside a_f^n in both, `measures` are those of the table (0: per radian of theta, 1: per solid angle,
    2: with the integrand's own cosine); `slope_from` is the n from which on the width's power law is taken; `near_deg`
    is what the table counts as "around theta = 0".
    """

    presets: Annotated[list[Preset], Field(min_length=1)] = ["nonabsorbing", "blond", "brown", "black"]
    step_deg: Annotated[float, Field(gt=0, le=15)] = 0.5
    shown_n: Numbers = [1.0, 5.0, 20.0, 50.0]
    fit_n: Numbers = [1.0, 2.0, 3.0, 5.0, 7.0, 10.0, 14.0, 20.0, 30.0, 50.0, 70.0, 100.0, 200.0, 400.0]
    cosines: Power = 0.0
    measures: Annotated[list[Power], Field(min_length=1)] = [0.0, 1.0, 2.0]
    slope_from: Annotated[float, Field(gt=0)] = 50.0
    near_deg: Annotated[float, Field(gt=0, lt=90)] = 30.0


def compute(settings: Figure1, work: Work) -> Data:
    """Attenuation per channel, densities, fits, and the caption's claims in numbers."""
    theta = torch.linspace(-90, 90, 2 * round(90 / settings.step_deg) + 1, dtype=torch.float64)
    arrays: dict[str, np.ndarray] = {"theta_deg": theta.numpy(), "n": np.array(settings.fit_n)}
    record: dict[str, Any] = {"presets": list(settings.presets), "shown_n": settings.shown_n,
                              "cosines": settings.cosines, "near_deg": settings.near_deg,
                              "slope_from": settings.slope_from, "width": {}, "claims": {}, "at_bounds": {},
                              "measures": {}}  # fmt: skip
    for name in record["presets"]:
        work.say(name)
        bsdf = DualScattering(Fiber.preset(name))
        found = bsdf.averages(torch.deg2rad(theta))
        arrays[f"{name}.a_f"], arrays[f"{name}.a_b"] = found.a_f.numpy(), found.a_b.numpy()
        fits = fit_transmittance(bsdf, settings.fit_n, cosines=settings.cosines)
        for key in _ANGLES:
            arrays[f"{name}.fit.{key}_deg"] = np.array([getattr(fit, key) for fit in fits]) * _DEG
        for key in _EXCESSES:
            arrays[f"{name}.fit.{key}"] = np.array([getattr(fit, key) for fit in fits])
        record["at_bounds"][name] = [list(fit.at_bounds) for fit in fits]
        record["width"][name] = _width_law(bsdf, theta, found.a_f.mean(-1), fits, settings)
        shown = fit_transmittance(bsdf, settings.shown_n, cosines=settings.cosines)
        arrays[f"{name}.density"], arrays[f"{name}.gaussian"] = _densities(theta, found.a_f.mean(-1), shown, settings)
        record["measures"][name] = [_measure(bsdf, power, settings.shown_n) for power in settings.measures]
        outgoing = DualScattering(Fiber.preset(name), convention=Convention.named(average_weight="outgoing"))
        other = outgoing.averages(torch.deg2rad(theta))
        record["claims"][name] = claims_of(theta, found, other, settings.fit_n, settings.near_deg)
    arrays["cosine"] = (torch.cos(torch.deg2rad(theta)) / 2 / _DEG).numpy()
    return Data(arrays, record)


def _densities(theta: Tensor, a_f: Tensor, fits: list[TransmittanceFit], settings: Figure1) -> tuple[Any, Any]:
    """a_f^n cos^k and the fitted Gaussians, per degree, `[n, T]` each."""
    radians, step = torch.deg2rad(theta), settings.step_deg
    edge = torch.tensor(HALF_PI, dtype=torch.float64)
    laws, gaussians = [], []
    for fit in fits:
        log = fit.n * torch.log(a_f.clamp_min(1e-300)) + settings.cosines * torch.log(torch.cos(radians).clamp_min(0))
        law = torch.exp(log - log.max())
        laws.append(law / torch.trapezoid(law, dx=step))
        centre, width = (torch.tensor(x, dtype=torch.float64) for x in (fit.centre, fit.width))
        log_p = truncated_normal_log_prob(radians.clamp(-HALF_PI, HALF_PI), centre, width, -edge, edge)
        gaussians.append(torch.exp(log_p) / _DEG)
    return torch.stack(laws).float().numpy(), torch.stack(gaussians).float().numpy()


def _width_law(
    bsdf: DualScattering, theta: Tensor, a_f: Tensor, fits: list[TransmittanceFit], settings: Figure1
) -> dict[str, float]:
    """Exponent of width ~ n^slope for large n, and what a quadratic peak of log a_f predicts: sqrt(n) width tends to
    1 / sqrt(kappa), kappa = -(log a_f)'' at the peak (degrees); nan where a_f has no hill around theta = 0."""
    large = [fit for fit in fits if fit.n >= settings.slope_from]
    slope = math.nan
    if len(large) > 1:
        slope = float(np.polyfit(np.log([f.n for f in large]), np.log([f.width for f in large]), 1)[0])
    inner = theta.abs() <= 45
    peak = float(theta[inner][a_f[inner].argmax()])
    near = torch.linspace(-_NEAR, _NEAR, 61, dtype=torch.float64)
    log = torch.log(bsdf.averages(torch.deg2rad(peak + near)).a_f.mean(-1))
    third, second, first, _ = np.polyfit(near.numpy(), log.numpy(), 3)
    at = -first / (2 * second)  # the peak itself, one step of Newton's method from the grid's
    curvature = 2 * second + 6 * third * at
    hill = abs(peak) < 45 and curvature < 0 and bool((a_f <= a_f[inner].max()).all())
    return {
        "slope": slope,
        "peak_deg": float(peak + at) if hill else math.nan,
        "limit_deg": 1 / math.sqrt(-curvature) if hill else math.nan,
        "last_deg": math.sqrt(fits[-1].n) * fits[-1].width * _DEG,
    }


def _measure(bsdf: DualScattering, power: float, n: list[float]) -> dict[str, Any]:
    """Excess of (33) and of the fitted Gaussian at every n, counted with cos^power."""
    fits = fit_transmittance(bsdf, n, cosines=power)
    return {"cosines": power, "cosine": [f.excess_cosine for f in fits], "gaussian": [f.excess for f in fits]}


EXPERIMENT = Experiment(
    title="Average forward and backward attenuation (the chapter's figure 1)",
    shows="a_f and a_b over inclination for every preset, with the spread of the channels; a_f^n as a density against "
    "cosθ/2 (33) and the fitted Gaussian; width, centre and excess over n; the caption's claims in numbers.",
    settings=Figure1,
    compute=compute,
    minutes=0.5,
    needs=("jax", "optimistix"),
    reproduces={
        "*.fit.excess*": Close(1e-4, 1e-8),
        "*.fit.*": Close(1e-4),
        "*.gaussian": Close(1e-4, 1e-7),
        "measures.*": Close(1e-4, 1e-8),
        "width.*.slope": Close(1e-4),
        "width.*.last_deg": Close(1e-4),
        "width.*": Close(1e-6),
        "*.a_?": Close(1e-10),
        "*.density": Close(1e-6, 1e-9),
        "claims.*": Close(1e-9),
        "cosine": Close(1e-12),
        "theta_deg": Close(1e-12),
    },
    small=("step_deg=5.0", "shown_n=[1.0, 20.0]", "fit_n=[1.0, 10.0, 100.0]", "measures=[0.0, 2.0]"),
)
