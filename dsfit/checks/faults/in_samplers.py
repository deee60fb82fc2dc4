"""Faults in proposals, lights and random numbers."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from dsfit.checks.faults import looks
from dsfit.checks.faults.planting import Fault, Patch, changed, scaled
from dsfit.context import Context
from dsfit.proposals.base import Proposal

PROPOSALS, SCENE = "dsfit.proposals", "dsfit.scene.lights"


def _chapter(name: str) -> Any:
    def make(context: Context) -> Proposal:
        from dsfit.proposals import chapter_proposals

        return chapter_proposals(looks.bsdf(), learnable=False)[name]

    return make


def _structured(context: Context) -> Proposal:
    from dsfit.proposals import StructuredProposal

    return StructuredProposal(looks.bsdf(), context)


def _mixture(context: Context) -> Proposal:
    from dsfit.proposals import Mixture

    return Mixture([_chapter(name)(context) for name in ("R", "TT", "TRT")], defensive=0.1)


def _lobes_light(context: Context) -> Proposal:
    from dsfit.scene import VonMisesFisherLights

    directions = torch.tensor([[0.3, 0.2], [-0.8, 2.0]], dtype=torch.float64)
    return VonMisesFisherLights(directions, [200.0, 5.0], [[1.0], [2.0]], 0.1).proposal()


def _environment(context: Context) -> Proposal:
    from dsfit.scene import EnvironmentLight

    rows, columns = torch.meshgrid(torch.arange(8), torch.arange(16), indexing="ij")
    image = torch.exp(-((rows - 2.0) ** 2 + (columns - 5.0) ** 2) / 4) + 0.05
    return EnvironmentLight(image[..., None].expand(-1, -1, 3)).proposal()


def _untruncated(window: Any) -> Any:
    """log of the whole Gaussian for the log of the part that can be reached."""

    def wrong(a: Tensor, b: Tensor, width: Tensor | None = None) -> Tensor:
        c = a.clamp_min(0) + b.clamp_max(0)
        return torch.full_like(a + b, 0.5 * math.log(2 * math.pi)) + 0.5 * c * c

    return wrong


def _unweighted(selected: Any) -> Any:
    """Components chosen with equal chances."""

    def wrong(self: Any, u: Tensor) -> Tensor:
        return (u * len(self.components)).long().clamp_max(len(self.components) - 1)

    return wrong


def _other_row(row: Any) -> Any:
    """A row ten further on."""

    def wrong(self: Any, theta_i: Tensor) -> tuple[Tensor, Tensor]:
        found, share = row(self, theta_i)
        return (found + 10).clamp_max(self.density.shape[0] - 2), share

    return wrong


def _half_window(sample: Any) -> Any:
    """The window of the scattered azimuth half as wide in the sampler."""

    def wrong(self: Any, u: Tensor, theta_i: Tensor) -> Tensor:
        return sample(self, torch.cat([u[..., :1] * 0.5 + 0.25, u[..., 1:]], dim=-1), theta_i)

    return wrong


def _with_row(sample: Any) -> Any:
    """The sampler alone sees the wrong rows; the density keeps the right ones."""

    def wrong(self: Any, u: Tensor, theta_i: Tensor) -> Tensor:
        original = type(self)._row
        try:
            type(self)._row = _other_row(original)
            return sample(self, u, theta_i)
        finally:
            type(self)._row = original

    return wrong


def _colatitude(omega: Tensor) -> Tensor:
    """Angle from the map's axis, the fibre's normal."""
    return torch.acos((torch.cos(omega[..., 0]) * torch.cos(omega[..., 1])).clamp(-1, 1))


SAMPLER_FAULTS = (
    Fault(
        "jacobian-cosine", f"{PROPOSALS}.base", "the 1 / cos(theta_i) of a density per steradian forgotten",
        (Patch(f"{PROPOSALS}.base:ProductDistribution._log_prob",
               changed(lambda log, self, theta_i, phi: log + torch.log(torch.cos(theta_i).clamp_min(1e-12)))),),
        "chi_square", looks.sampling(_chapter("TT")),
    ),
    Fault(
        "jacobian-two", f"{PROPOSALS}.inclination", "the Jacobian |d theta_h / d theta_i| = 1/2 forgotten",
        (Patch(f"{PROPOSALS}.inclination:TruncatedGaussianInclination.log_prob",
               changed(lambda log, *_: log + math.log(2))),),
        "chi_square", looks.sampling(_chapter("TT")),
    ),
    Fault(
        "truncation", "dsfit.special", "lobes are not normalised over what can be reached",
        (Patch("dsfit.special:log_window", _untruncated),), "chi_square",
        looks.sampling(_chapter("TRT"), theta_r=looks.degrees(85)),
    ),
    Fault(
        "inverse-cdf", "dsfit.special", "the inverse CDF of the normal law five per cent too wide",
        (Patch("dsfit.special:_standard_offset", scaled(1.05)),), "chi_square", looks.sampling(_chapter("TT")),
    ),
    Fault(
        "azimuth-window", f"{PROPOSALS}.azimuth", "the half circle of the scattered azimuth drawn half as wide",
        (Patch(f"{PROPOSALS}.azimuth:ScatteredLaw.sample", _half_window),), "chi_square",
        looks.sampling(_chapter("MG_TT"), n=3.0),
    ),
    Fault(
        "mixture-choice", f"{PROPOSALS}.mixture", "components chosen with equal chances whatever their weights",
        (Patch(f"{PROPOSALS}.mixture:MixtureDistribution.selected", _unweighted),), "chi_square",
        looks.sampling(_mixture),
    ),
    Fault(
        "table-row", f"{PROPOSALS}.conditional", "the sampler reads its azimuth tables ten rows off",
        (Patch(f"{PROPOSALS}.conditional:ConditionalAzimuth.sample", _with_row),),
        "chi_square", looks.sampling(_structured),
    ),
    Fault(
        "light-width", f"{SCENE}.lobes", "the normaliser of a lobe of light 3 % too large",
        (Patch(f"{SCENE}.lobes:log_normaliser", changed(lambda log, kappa: log + 0.03)),), "chi_square",
        looks.sampling(_lobes_light),
    ),
    Fault(
        "environment-sine", f"{SCENE}.environment", "the area of the map's texels forgotten in the density",
        (Patch(f"{SCENE}.environment:EnvironmentDistribution.log_prob",
               changed(lambda log, self, omega: log - torch.log(torch.sin(_colatitude(omega)).clamp_min(1e-9)))),),
        "chi_square", looks.sampling(_environment),
    ),
    Fault(
        "random-even", "dsfit.random", "uniform numbers that are not quite uniform: u^1.05",
        (Patch("dsfit.random:_rand", changed(lambda u, *_: u**1.05)),), "chi_square", looks.sampling(_chapter("TT")),
    ),
    Fault(
        "wrapped-azimuth", f"{PROPOSALS}.base", "the sign of phi = phi_r - phi_i turned in the density",
        (Patch(f"{PROPOSALS}.base:ProductDistribution.log_prob",
               lambda original: lambda self, omega: original(self, omega * torch.tensor([1.0, -1.0]).to(omega))),),
        "chi_square", looks.sampling(_chapter("TT")),
    ),
)  # fmt: skip
