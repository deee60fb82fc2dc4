"""Fits of proposals to integrands that are known through samples only; see `fit.fit_stochastic`."""

from __future__ import annotations

from dsfit.fit.stochastic.adam import Adam
from dsfit.fit.stochastic.estimates import SampledExcess, improvement, sampled_excess
from dsfit.fit.stochastic.fit import SOLVERS, StochasticFit, fit_stochastic
from dsfit.fit.stochastic.gauss_newton import GaussNewton
from dsfit.fit.stochastic.noise import NoisyRadiance
from dsfit.fit.stochastic.samples import Draws, draw, sampling_law
from dsfit.fit.stochastic.setting import Progress

__all__ = [
    "SOLVERS",
    "Adam",
    "Draws",
    "GaussNewton",
    "NoisyRadiance",
    "Progress",
    "SampledExcess",
    "StochasticFit",
    "draw",
    "fit_stochastic",
    "improvement",
    "sampled_excess",
    "sampling_law",
]
