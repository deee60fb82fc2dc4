"""One proposal for every shading context of a fibre: the integrand's own lobes, whose weights and shapes are smooth
functions of the context."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from dsfit.bsdf.attenuation import lobe_energies
from dsfit.bsdf.azimuthal import refractions
from dsfit.bsdf.dual_scattering import DualScattering
from dsfit.context import Context
from dsfit.errors import InputError, as_number
from dsfit.frame import HALF_PI, cos_inclination
from dsfit.proposals.base import Azimuthal, ProductDistribution, Proposal
from dsfit.proposals.mixture import MixtureDistribution
from dsfit.proposals.network import Network, bounded
from dsfit.proposals.parameters import STD_BOUNDS
from dsfit.proposals.split_lobe import SplitGaussianInclination
from dsfit.proposals.structured import azimuth_tables
from dsfit.proposals.uniform import BackHalf, UniformAzimuth, UniformSphere

_ROWS = 257
_SHIFT, _STRETCH = 4.0, 3.0
_TINY = 1e-30


@dataclass(frozen=True)
class MixtureShape:
    """What the mixture is at each context, each `[*batch, K]`: log weights of the K components (normalised to
    1 - defensive), and mode and widths of theta_h below and above it, radians."""

    log_weights: Tensor
    mode: Tensor
    below: Tensor
    above: Tensor


class LobeTable(torch.nn.Module):
    """What the BSDF's lobes are at a viewing inclination, from a table over theta_r: energies and transmittance of each
    at the specular guess theta_i = 2 alpha_p - theta_r (at -theta_r for averages).

    Linear between rows, in logs where magnitudes explode.
    """

    table: Tensor

    def __init__(self, bsdf: DualScattering) -> None:
        super().__init__()
        with torch.no_grad():
            theta_r = torch.linspace(-HALF_PI, HALF_PI, _ROWS, dtype=torch.float64)
            average, fiber = bsdf.averages(-theta_r), bsdf.fiber
            alpha = fiber.alpha.to(torch.float64)
            theta_i = (2 * alpha - theta_r[:, None]).clamp(-HALF_PI, HALF_PI)
            diff = (theta_r[:, None] - theta_i) / 2
            bent = refractions(fiber, diff, torch.full_like(diff, math.pi / 4))
            energies = lobe_energies(bent, fiber.sigma_a.to(torch.float64), bsdf.convention.absorption)
            own = torch.stack([energies[:, p, p, :] for p in range(3)], dim=1)
            seen = (cos_inclination(theta_i) / cos_inclination(diff)) ** 2
            lobes = torch.log(own * seen.clamp_min(1e-6)[..., None] + _TINY)
            around = 4.0 if bsdf.convention.back_azimuth == "all" else 2.0
            back = torch.log(around * bsdf.d_b.to(torch.float64) * average.A_b + _TINY)
            passed = torch.log(average.a_f.clamp_min(_TINY))
            rows = [*lobes.unbind(1), back, passed, average.beta_f**2, average.delta_b, average.sigma_b**2]
        self.channels = bsdf.channels
        self.register_buffer("table", torch.cat(rows, dim=-1).contiguous())

    def forward(self, theta_r: Tensor) -> tuple[Tensor, ...]:
        """log E_R, log E_TT, log E_TRT, log E_back, log a_f, beta_f^2, Delta_b, sigma_b^2, each `[*batch, C]`."""
        position = (theta_r / math.pi + 0.5).clamp(0.0, 1.0) * (_ROWS - 1)
        row = position.detach().to(torch.int64).clamp(0, _ROWS - 2)
        table = self.table.to(theta_r)
        low, high = table[row.reshape(-1)], table[row.reshape(-1) + 1]
        value = torch.lerp(low, high, (position - row).reshape(-1, 1)).reshape(*theta_r.shape, -1)
        return value.split(self.channels, dim=-1)


def _norm(log_value: Tensor) -> Tensor:
    """log of the Euclidean norm over channels of exp(log_value)."""
    return 0.5 * torch.logsumexp(2 * log_value, dim=-1)


class AmortisedProposal(Proposal):
    """Mixture of the integrand's own lobes for every context (theta_r, n, v) of one fibre.

    Components: R, TT, TRT with the fibre's azimuths given theta_diff; the same scattered (azimuths N^G); back
    scattering, if d_b > 0; one broad lobe; the defensive share of the uniform sphere. theta_i comes from split
    Gaussians in theta_h. Their centres, widths and weights are those of the lobes at the specular guess, in closed
    form, corrected by a small network of features of the context:

        mode = center + width x_1,  below = width e^{x_2},  above = width e^{x_3},  log weight = log energy + x_4.

    Widths of scattered lobes are sqrt(beta_p^2 + n beta_f^2), energies d_f a_f^n E_p (1 - v), so the mixture follows n
    and v beyond what it was trained on. Shares of exactly 0 (v = 0 or v = 1) leave the component out of that context.

    Args:
        bsdf: the BSDF whose azimuths and averages shape the mixture.
        hidden: sizes of the network's hidden layers.
        defensive: share of the uniform sphere, in (0, 1); bounds every weight by 4 pi |f| / defensive.
        seed: of the network's first weights. Untrained, the correction is zero.

    Raises:
        InputError: a batch of fibres, or `defensive` out of range.
    """

    def __init__(
        self, bsdf: DualScattering, hidden: tuple[int, ...] = (32, 32), defensive: float = 0.001, *, seed: int = 0
    ) -> None:
        super().__init__()
        if bsdf.fiber.batch_shape:
            raise InputError("bsdf.fiber", tuple(bsdf.fiber.batch_shape), "a single fibre")
        self.defensive = as_number("defensive", defensive, 0.0, 1.0, open_low=True, open_high=True)
        self.back = bool(bsdf.d_b > 0)
        self.lobes = LobeTable(bsdf)
        self.register_buffer("alpha", bsdf.fiber.alpha.detach().to(torch.float64))
        self.register_buffer("variance", bsdf.fiber.beta.detach().to(torch.float64) ** 2)
        self.log_density = math.log(max(float(bsdf.d_f), _TINY))
        names = ["R", "TT", "TRT", "R_scattered", "TT_scattered", "TRT_scattered"]
        laws: list[Azimuthal] = [*azimuth_tables(bsdf, False), *azimuth_tables(bsdf, True)]
        if self.back:
            names.append("back")
            laws.append(BackHalf() if bsdf.convention.back_azimuth == "back" else UniformAzimuth())
        self.names = (*names, "broad")
        self.laws = torch.nn.ModuleList([*laws, UniformAzimuth()])
        self.sphere = UniformSphere()
        generator = torch.Generator().manual_seed(seed)
        self.network = Network((_FEATURES, *hidden, 4 * len(self.names)), generator)

    def shape(self, context: Context) -> MixtureShape:
        """Weights, modes and widths of the components at these contexts."""
        center, width, energy, features = self.start(context)
        shift, below, above, weight = self.network(features).unflatten(-1, (4, len(self.names))).unbind(-2)
        logits = energy + weight
        log_weights = torch.log_softmax(logits, dim=-1) + math.log1p(-self.defensive)
        low, high = STD_BOUNDS
        return MixtureShape(
            log_weights,
            center + width * bounded(shift, _SHIFT),
            (width * torch.exp(bounded(below, _STRETCH))).clamp(low, high),
            (width * torch.exp(bounded(above, _STRETCH))).clamp(low, high),
        )

    def start(self, context: Context) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Centres, widths and log energies `[*batch, K]` that the network corrects, and its features."""
        theta_r, n, v = context.theta_r, context.n, context.v
        *lobes, back, passed, beta2, delta_b, sigma2 = self.lobes(theta_r)
        alpha, variance = self.alpha.to(theta_r), self.variance.to(theta_r)
        log_passed = self.log_density + n.unsqueeze(-1) * passed
        lit, unlit = _log_share(v), _log_share(1 - v)
        mean2 = (torch.softmax(log_passed, dim=-1) * beta2).sum(-1)
        wide = n * mean2
        direct = [lit + _norm(x) for x in lobes]
        scattered = [unlit + _norm(log_passed + x) for x in lobes]
        center = [*alpha.expand(*theta_r.shape, 3).unbind(-1)] * 2
        square = [*variance.expand(*theta_r.shape, 3).unbind(-1)]
        square = [*square, *(x + wide for x in square)]
        energy = [*direct, *scattered]
        if self.back:
            near, far = lit + _norm(back), unlit + _norm(log_passed + back)
            share = torch.softmax(back + torch.logaddexp(lit.unsqueeze(-1), unlit.unsqueeze(-1) + log_passed), dim=-1)
            energy.append(torch.logaddexp(near, far))
            center.append((share * delta_b).sum(-1))
            square.append((share * sigma2).sum(-1) + torch.sigmoid(far - near) * wide)
        total = torch.logsumexp(torch.stack(energy, dim=-1), dim=-1)
        energy.append(total + math.log(0.01))
        center.append(torch.zeros_like(theta_r))
        square.append(torch.full_like(theta_r, 0.36))
        log_direct, log_scattered = (torch.logsumexp(torch.stack(x, dim=-1), dim=-1) for x in (direct, scattered))
        features = _features(theta_r, n, v, torch.sqrt(wide), torch.sigmoid(log_direct - log_scattered), log_passed)
        stack = (torch.stack(x, dim=-1) for x in (center, square, energy))
        center_all, square_all, energy_all = stack
        return center_all, torch.sqrt(square_all), energy_all, features

    def forward(self, context: Context) -> MixtureDistribution:
        shape = self.shape(context)
        parts = []
        columns = (shape.mode.unbind(-1), shape.below.unbind(-1), shape.above.unbind(-1))
        for law, mode, below, above in zip(self.laws, *columns, strict=True):
            lobe = SplitGaussianInclination(context.theta_r, mode, below, above)
            parts.append(ProductDistribution(context, lobe, law(context)))
        share = torch.full_like(shape.log_weights[..., :1], math.log(self.defensive))
        return MixtureDistribution([*parts, self.sphere(context)], torch.cat([shape.log_weights, share], dim=-1))


_FEATURES = 9


def _features(theta_r: Tensor, n: Tensor, v: Tensor, wide: Tensor, direct: Tensor, log_passed: Tensor) -> Tensor:
    """What the network sees, `[*batch, 9]`: inclination, depth, widening, what is lit, and how coloured the rest is."""
    colour = torch.exp(log_passed.amin(-1) - log_passed.amax(-1))
    columns = [
        theta_r / HALF_PI,
        torch.cos(theta_r),
        torch.sin(2 * theta_r),
        torch.log1p(n) / 3,
        n / (n + 4),
        wide / (wide + 0.5),
        v,
        direct,
        colour,
    ]
    return torch.stack(torch.broadcast_tensors(*columns), dim=-1)


def _log_share(share: Tensor) -> Tensor:
    zero = share <= 0
    return torch.log(torch.where(zero, 1.0, share)).masked_fill(zero, -math.inf)
