"""Your own integrand: Kajiya and Kay's hair under a sky of your own, a mixture fitted to it, and what that saves.

python experiments/examples/own_integrand.py
"""

from __future__ import annotations

import torch
from torch import Tensor

import dsfit
from dsfit.proposals import CauchyLobe, Mixture, Product, UniformAzimuth, UniformSphere, WrappedGaussian


def shading(omega_i: Tensor, context: dsfit.Context) -> Tensor:
    """Kajiya and Kay (1989): diffuse and specular hair lit from behind, by a sky brightest at phi = pi."""
    theta_i, phi_i = omega_i.unbind(-1)
    specular = torch.cos(theta_i + context.theta_r).clamp_min(0) ** 60
    sky = 0.2 + torch.exp(-8 * (torch.cos(context.phi_r - phi_i) + 1))
    return ((0.3 + 2.0 * specular) * torch.cos(theta_i) * sky)[..., None]


def main() -> dict[str, float]:
    """Fit, judge by quadrature, and draw."""
    context = dsfit.Context(theta_r=0.5)
    integrand = dsfit.FunctionIntegrand(shading, inclinations=[-0.5], is_even=True)
    specular = Product(CauchyLobe(0.0, 0.1), WrappedGaussian(0.4))
    diffuse = Product(CauchyLobe(0.25, 0.5), WrappedGaussian(0.4))
    streak = Product(CauchyLobe(0.0, 0.1), UniformAzimuth())
    start = Mixture([specular, diffuse, streak], defensive=0.1)
    fit = dsfit.fit(start, integrand, context)
    found = {
        "uniform": float(dsfit.excess(integrand, UniformSphere(), context).value),
        "start": float(dsfit.excess(integrand, start, context).value),
        "fitted": float(dsfit.excess(integrand, fit.proposal, context).value),
    }
    generator = torch.Generator().manual_seed(1)
    drawn = dsfit.estimate(integrand, fit.proposal, context, 4096, generator=generator)
    exact = dsfit.reference(integrand, context)
    found |= {"estimate": float(drawn.value), "error": float(drawn.standard_error), "exact": float(exact.value)}
    return found


if __name__ == "__main__":
    for name, value in main().items():
        print(f"{name:<10}{value:.6g}")
