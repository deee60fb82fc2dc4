"""A torch module inside an optimistix solver: absorption, width and refractive index of a fibre from what it scatters.

    python experiments/examples/torch_in_optimistix.py

The "measurement" is made by a fibre that the fit is not told, with noise of one per cent.
"""

from __future__ import annotations

import jax.numpy as jnp
import optimistix as optx
import torch
from torch import Tensor, nn
from torch.func import functional_call

import dsfit
from dsfit.fit.bridge import bridge, x64


class Goniometer(nn.Module):
    """Log of single scattering f_s cos(theta_i) towards directions in and beside the plane of incidence."""

    def __init__(self, sigma_a: list[float], width: float, eta: float) -> None:
        super().__init__()
        start = [*torch.tensor(sigma_a).log(), torch.tensor(width).log(), torch.tensor(eta - 1).log()]
        self.raw = nn.Parameter(torch.tensor(start, dtype=torch.float64))
        theta = torch.linspace(-1.2, 0.6, 19, dtype=torch.float64)
        phi = torch.tensor([0.0, 0.7, 2.0, 2.6, 3.1], dtype=torch.float64)
        self.theta_i, self.phi = torch.meshgrid(theta, phi, indexing="ij")

    def fiber(self) -> dsfit.Fiber:
        """The fibre of the present parameters; widths of R, TT and TRT as 2 : 1 : 4."""
        width = self.raw[3].exp()
        ratio = torch.tensor([2.0, 1.0, 4.0], dtype=torch.float64)
        return dsfit.Fiber(sigma_a=self.raw[:3].exp(), beta=width * ratio, eta=1 + self.raw[4].exp())

    def forward(self) -> Tensor:
        """What is seen, `[19 * 5 * 3]`."""
        bsdf = dsfit.DualScattering(self.fiber(), d_b=0.0)
        return torch.log(bsdf(self.theta_i, 0.3, self.phi, 0.0, 1.0)).flatten()


def main() -> dict[str, list[float]]:
    """Make the measurement, fit, compare."""
    truth, model = Goniometer([0.08, 0.15, 0.3], 0.06, 1.52), Goniometer([0.2, 0.2, 0.2], 0.1, 1.6)
    generator = torch.Generator().manual_seed(1)
    with torch.no_grad():
        clean = truth()
        measured = clean + 0.01 * torch.randn(clean.shape, generator=generator, dtype=torch.float64)
    with x64():
        residual = bridge(lambda y: functional_call(model, {"raw": y}, ()) - measured, outputs=len(measured))
        solver = optx.LevenbergMarquardt(rtol=1e-8, atol=1e-8)
        start = jnp.asarray(model.raw.detach().numpy())
        found = optx.least_squares(lambda y, _: residual(y), solver, start, max_steps=100)
        fitted = torch.tensor(found.value.tolist(), dtype=torch.float64)
        rms = float(jnp.sqrt(jnp.mean(residual(found.value) ** 2)))

    def readable(raw: Tensor) -> list[float]:
        return [*raw[:4].exp().tolist(), 1 + float(raw[4].exp())]

    return {"true": readable(truth.raw.detach()), "fitted": readable(fitted), "rms residual": [rms]}


if __name__ == "__main__":
    for name, values in main().items():
        print(f"{name:<14}", "  ".join(f"{value:.5f}" for value in values))
