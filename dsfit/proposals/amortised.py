"""One proposal for every shading context of a fibre: the integrand's own lobes, whose weights and shapes are smooth
functions of the context."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from dsfit.bsdf.dual_scattering import DualScattering
from dsfit.context import Context
from dsfit.errors import InputError, as_number
from dsfit.frame import HALF_PI
from dsfit.proposals.base import Azimuthal, ProductDistribution, Proposal
from dsfit.proposals.lobe_moments import DIRECT, SCATTERED, LobeMoments
from dsfit.proposals.mixture import MixtureDistribution
from dsfit.proposals.network import Network, bounded, soft
from dsfit.proposals.parameters import STD_BOUNDS
from dsfit.proposals.split_lobe import SplitGaussianInclination
from dsfit.proposals.structured import azimuth_tables
from dsfit.proposals.uniform import BackHalf, UniformAzimuth, UniformSphere
from dsfit.special import log_share

_SHIFT, _STRETCH = 4.0, 3.0


@dataclass(frozen=True)
class MixtureShape:
    """What the mixture is at each context, each `[*batch, K]`: log weights of the K components (normalised to
    1 - defensive), and mode and widths of theta_h below and above it, radians."""

    log_weights: Tensor
    mode: Tensor
    below: Tensor
    above: Tensor


class AmortisedProposal(Proposal):
    """Mixture of the integrand's own lobes for every context (theta_r, n, v) of one fibre.

    Components: R, TT, TRT with the fibre's azimuths given theta_diff; the same scattered (azimuths N^G), where R has
    three; back scattering, if d_b > 0; one broad lobe; the defensive share of the uniform sphere. theta_i comes from
    split Gaussians in theta_h, which start at the moments m, s_-, s_+ and the energies E of the lobes (tables over
    theta_r and n, `LobeMoments`; energies times v or 1 - v) and are corrected by a small network of the context:

        mode = m + sqrt(s_- s_+) x_1,  below = s_- e^{x_2},  above = s_+ e^{x_3},  log weight = log E + x_4.

    So the mixture follows n and v beyond what it was trained on. Shares of exactly 0 (v = 0 or v = 1) leave the
    component out of that context.

    Args:
        bsdf: the BSDF whose azimuths and averages shape the mixture.
        hidden: sizes of the network's hidden layers.
        defensive: share of the uniform sphere, in (0, 1); bounds every weight by 4 pi |f| / defensive.
        seed: of the network's first weights. Untrained, the correction is zero.

    Raises:
        InputError: a batch of fibres, or `defensive` out of range.

    Example:
        >>> import torch
        >>> import dsfit
        >>> proposal = dsfit.AmortisedProposal(dsfit.DualScattering(dsfit.Fiber.preset("blond"), precision="table"))
        >>> law = proposal(dsfit.Context([0.0, 0.5], n=0.0))
        >>> omega = law.sample(torch.rand(10, 2, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0)))
        >>> omega.shape, law.log_prob(omega).shape
        (torch.Size([10, 2, 2]), torch.Size([10, 2]))
    """

    def __init__(
        self, bsdf: DualScattering, hidden: tuple[int, ...] = (32, 32), defensive: float = 0.001, *, seed: int = 0
    ) -> None:
        super().__init__()
        if bsdf.fiber.batch_shape:
            raise InputError("bsdf.fiber", tuple(bsdf.fiber.batch_shape), "a single fibre")
        self.defensive = as_number("defensive", defensive, 0.0, 1.0, open_low=True, open_high=True)
        for size in hidden:
            if isinstance(size, bool) or not isinstance(size, int) or size < 1:
                raise InputError("hidden", hidden, "integers >= 1")
        self.register_buffer("fiber", fiber_numbers(bsdf))
        self.lobes = LobeMoments(bsdf)
        direct, scattered = azimuth_tables(bsdf, False), azimuth_tables(bsdf, True)
        laws: list[Azimuthal] = [*direct, *scattered, scattered[0], scattered[0]]
        names = [*DIRECT, *SCATTERED]
        if self.lobes.back:
            names.append("back")
            laws.append(BackHalf() if bsdf.convention.back_azimuth == "back" else UniformAzimuth())
        self.names = (*names, "broad")
        self.laws = torch.nn.ModuleList([*laws, UniformAzimuth()])
        self.sphere = UniformSphere()
        generator = torch.Generator().manual_seed(seed)
        self.network = Network((_FEATURES, *hidden, 4 * len(self.names)), generator)

    def shape(self, context: Context) -> MixtureShape:
        """Weights, modes and widths of the components at these contexts."""
        mode, below, above, energy, features = self.start(context)
        x = self.network(features).unflatten(-1, (4, len(self.names)))
        log_weights = torch.log_softmax(energy + x[..., 3, :], dim=-1) + math.log1p(-self.defensive)
        low, high = STD_BOUNDS
        width = torch.exp(0.5 * (below + above))
        return MixtureShape(
            log_weights,
            mode + width * bounded(x[..., 0, :], _SHIFT),
            torch.exp(below + bounded(x[..., 1, :], _STRETCH)).clamp(low, high),
            torch.exp(above + bounded(x[..., 2, :], _STRETCH)).clamp(low, high),
        )

    def start(self, context: Context) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        """Modes, log widths below and above and log energies `[*batch, K]` that the network corrects, and its
        features."""
        theta_r, n, v = context.theta_r, context.n, context.v
        near, far = self.lobes(theta_r, n)
        features = _features(context, near, far)
        near, far = _shared(near, v), _shared(far, 1 - v)
        parts = [near[..., :3], far[..., :5]]
        if self.lobes.back:
            parts.append(_together(near[..., 3:], far[..., 5:]))
        moments = torch.cat(parts, dim=-1)
        energy, mean, below, above = moments.unbind(-2)
        total = torch.logsumexp(energy, dim=-1, keepdim=True)
        wide = torch.full_like(total, math.log(0.6))
        columns = ((energy - total, math.log(0.01)), (mean, 0.0), (below, wide), (above, wide))
        energy, mean, below, above = (torch.cat([x, torch.zeros_like(total) + more], dim=-1) for x, more in columns)
        return mean, below, above, energy, features

    def forward(self, context: Context) -> MixtureDistribution:
        shape = self.shape(context)
        parts = []
        columns = (shape.mode.unbind(-1), shape.below.unbind(-1), shape.above.unbind(-1))
        for law, mode, below, above in zip(self.laws, *columns, strict=True):
            lobe = SplitGaussianInclination(context.theta_r, mode, below, above)
            parts.append(ProductDistribution(context, lobe, law(context)))
        share = torch.full_like(shape.log_weights[..., :1], math.log(self.defensive))
        return MixtureDistribution([*parts, self.sphere(context)], torch.cat([shape.log_weights, share], dim=-1))


def fiber_numbers(bsdf: DualScattering) -> Tensor:
    """All numbers of a fibre and the density factors in one row, float64: what two BSDFs have to share for one
    proposal to serve both."""
    numbers = [*bsdf.fiber.parameters().values(), bsdf.d_f, bsdf.d_b]
    return torch.cat([x.detach().to(torch.float64).reshape(-1) for x in numbers])


_FEATURES = 10


def _features(context: Context, near: Tensor, far: Tensor) -> Tensor:
    """What the network sees, `[*batch, 10]`: inclination and how grazing it is, depth, widening, and which light
    dominates."""
    theta_r, n, v = context.theta_r, context.n, context.v
    energy = far[..., 0, :]
    ratio = torch.logsumexp(near[..., 0, :], dim=-1) - torch.logsumexp(energy, dim=-1)
    lit = ratio + log_share(v) - log_share(1 - v)
    columns = [
        theta_r / HALF_PI,
        torch.sin(2 * theta_r),
        torch.cos(theta_r),
        theta_r / (torch.cos(theta_r).clamp_min(0.0) + 0.15) / 5,
        torch.log1p(n) / 3,
        n / (n + 4),
        far[..., 2, 1] + 1,
        v,
        soft(lit.clamp(-100.0, 100.0) / 3),
        soft((energy[..., 1] - energy[..., [0, 3, 4]].logsumexp(dim=-1)).clamp(-100.0, 100.0) / 3),
    ]
    return torch.stack(columns, dim=-1)


def _together(near: Tensor, far: Tensor) -> Tensor:
    """Moments `[*batch, 4, 1]` of two lobes as those of one: energies add, the others are means by energy."""
    share = torch.softmax(torch.cat([near[..., :1, :], far[..., :1, :]], dim=-1), dim=-1)
    share = torch.where(share.isnan(), 0.5, share)
    energy = torch.logaddexp(near[..., :1, :], far[..., :1, :])
    rest = share[..., :1] * near[..., 1:, :] + share[..., 1:] * far[..., 1:, :]
    return torch.cat([energy, rest], dim=-2)


def _shared(moments: Tensor, share: Tensor) -> Tensor:
    """Moments `[*batch, 4, k]` of a share of the light."""
    energy = moments[..., :1, :] + log_share(share)[..., None, None]
    return torch.cat([energy, moments[..., 1:, :]], dim=-2)
