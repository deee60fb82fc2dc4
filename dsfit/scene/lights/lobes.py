"""Smooth lobes on the sphere: von Mises-Fisher lights from the whole sky (kappa = 0) to less than a tenth of a degree.

Density and inverse CDF: Fisher, "Dispersion on a sphere" (1953); the stable forms follow Jakob, "Numerically stable
sampling of the von Mises-Fisher distribution on S^2 (and other tricks)" (2012).
"""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from dsfit.arguments import check_directions, check_uniforms
from dsfit.context import Context
from dsfit.errors import InputError, as_real, check_choice, check_range
from dsfit.frame import to_angles, to_vector
from dsfit.proposals.base import Proposal
from dsfit.scene.lights.base import Light, LightDistribution, LightProposal, around, tidy

MAX_KAPPA = 1e6
LOG_TWO_PI = math.log(2 * math.pi)


def log_normaliser(kappa: Tensor) -> Tensor:
    """log of the von Mises-Fisher peak density, C = kappa / (2 pi (1 - exp(-2 kappa))); 1 / (4 pi) at kappa = 0."""
    small = kappa < 1e-2
    safe = torch.where(small, 1.0, kappa)
    large = torch.log(safe) - torch.log(-torch.expm1(-2 * safe))
    # 2k / (1 - exp(-2k)) = 1 + k + k^2/3 - k^4/45 + 2 k^6/945 - ...; the next term is 1e-18 at k = 1e-2.
    k = torch.where(small, kappa, 0.0)
    series = torch.log1p(k + k * k / 3 - k**4 / 45 + 2 * k**6 / 945) - math.log(2)
    return torch.where(small, series, large) - LOG_TWO_PI


def unit_vectors(field: str, directions: Any) -> Tensor:
    """Directions `[K, 2]` (theta, phi) or `[K, 3]` vectors of any length > 0, to unit vectors `[K, 3]`."""
    value = torch.atleast_2d(as_real(field, directions))
    if value.dim() != 2 or value.shape[-1] not in (2, 3) or value.shape[0] == 0:
        raise InputError(field, tuple(value.shape), "shape [K, 2] (theta, phi) or [K, 3] (vectors)")
    check_range(field, value)
    if value.shape[-1] == 2:
        return to_vector(value)
    length = value.norm(dim=-1, keepdim=True)
    if (length == 0).any():
        raise InputError(field, value.tolist(), "vectors of length > 0")
    return value / length


class VonMisesFisherLights(Light):
    """A sum of lobes over a constant: `L(w) = sum_k I_k C(kappa_k) exp(kappa_k (w . mu_k - 1)) + ambient`.

    With `kind="total"` the intensity I_k is the radiance of lobe k integrated over the sphere, `∫ L_k dω = I_k`, so
    changing kappa changes the lobe's width and not its power. With `kind="peak"` the numbers given are peak radiances
    `L_k(mu_k)`, and `I_k = peak_k / C(kappa_k)`. The attribute `intensity` is always the total.

    Args:
        directions: mean directions in the light's frame, `[K, 2]` as (theta, phi) or `[K, 3]` as vectors.
        kappa: concentration, a number or `[K]`, in [0, 1e6]; the lobe is nearly a Gaussian of standard deviation
            1/sqrt(kappa) radians on each axis: see `kappa_of_width`.
        intensity: `[K, C]`; a number or `[K]` for one channel; `[C]` if K = 1. Finite and >= 0.
        ambient: constant radiance, a number or `[C]`.
        kind: "total" or "peak".
        rotation: see `Light`.

    Raises:
        InputError: an argument is out of range, shapes do not fit, or all intensities and the ambient are zero.

    Example:
        >>> import math
        >>> import torch
        >>> from dsfit.scene.lights import VonMisesFisherLights
        >>> kappa = VonMisesFisherLights.kappa_of_width(math.radians(12))
        >>> light = VonMisesFisherLights([[0.3, 2.5]], kappa, ambient=0.02)
        >>> omega_i = torch.tensor([[0.3, 2.5], [0.0, 0.0]], dtype=torch.float64)  # the lobe's centre, and elsewhere
        >>> [round(x, 3) for x in light(omega_i)[..., 0].tolist()]
        [3.648, 0.02]
    """

    directions: Tensor
    kappa: Tensor
    intensity: Tensor
    ambient: Tensor

    def __init__(
        self,
        directions: Any,
        kappa: Any,
        intensity: Any = 1.0,
        ambient: Any = 0.0,
        *,
        kind: str = "total",
        rotation: Any = None,
    ) -> None:
        super().__init__(rotation)
        mu = unit_vectors("directions", directions)
        count = mu.shape[0]
        kappa = check_range("kappa", as_real("kappa", kappa), 0.0, MAX_KAPPA)
        if kappa.dim() > 1 or kappa.numel() not in (1, count):
            raise InputError("kappa", tuple(kappa.shape), f"a number or shape [{count}]")
        total = check_range("intensity", as_real("intensity", intensity), 0.0)
        if total.dim() == 1:
            total = total.reshape(1, -1) if count == 1 else total.reshape(-1, 1)
        if total.dim() > 2 or (total.dim() == 2 and (total.shape[0] != count or total.shape[1] == 0)):
            raise InputError("intensity", tuple(total.shape), f"a number or shape [{count}, C]")
        total = total.expand(count, 1) if total.dim() == 0 else total
        ambient = check_range("ambient", torch.atleast_1d(as_real("ambient", ambient)), 0.0)
        sizes = {total.shape[1], ambient.numel()} - {1}
        if ambient.dim() != 1 or len(sizes) > 1:
            raise InputError("ambient", tuple(ambient.shape), f"a number or shape [{total.shape[1]}]")
        size = max(sizes, default=1)
        kappa = kappa.expand(count)
        if check_choice("kind", kind, ("total", "peak")) == "peak":
            total = total * torch.exp(-log_normaliser(kappa)).unsqueeze(-1)
        if not (total > 0).any() and not (ambient > 0).any():
            raise InputError("intensity", total.tolist(), "at least one lobe or an ambient above zero")
        for name, value in (("directions", mu), ("kappa", kappa)):
            self.register_buffer(name, value)
        self.register_buffer("intensity", total.expand(count, size))
        self.register_buffer("ambient", ambient.expand(size))

    @staticmethod
    def kappa_of_width(width: Any) -> Tensor:
        """Concentration of a narrow lobe whose standard deviation on each axis is `width` radians: 1 / width^2."""
        return check_range("width", as_real("width", width), MAX_KAPPA**-0.5).pow(-2).clamp_max(MAX_KAPPA)

    @property
    def channels(self) -> int:  # type: ignore[override]
        return self.intensity.shape[1]

    @property
    def label(self) -> str:
        return f"{self.kappa.shape[0]} lobe" + "s" * (self.kappa.shape[0] != 1)

    def log_shapes(self, omega_i: Tensor) -> Tensor:
        """Log densities `[..., K]` of the unit lobes at directions `[..., 2]`."""
        mu = self.to_fibre_means().to(omega_i)
        # |w - mu|^2 / 2 = 1 - w . mu without its cancellation: in float32 the lobe keeps its shape at kappa = 1e6.
        distance2 = (to_vector(omega_i).unsqueeze(-2) - mu).square().sum(-1)
        kappa = self.kappa.to(omega_i)
        return log_normaliser(kappa) - kappa * distance2 / 2

    def to_fibre_means(self) -> Tensor:
        """Mean directions `[..., K, 3]` in the fibre frame."""
        if self.rotation is None:
            return self.directions
        return self.directions @ self.rotation.to(self.directions).mT

    def forward(self, omega_i: Tensor) -> Tensor:
        check_directions(omega_i, field="omega_i")
        return torch.exp(self.log_shapes(omega_i)) @ self.intensity.to(omega_i) + self.ambient.to(omega_i)

    def total(self) -> Tensor:
        """∫ L dω `[C]`."""
        return self.intensity.sum(0) + 4 * math.pi * self.ambient

    def power(self) -> Tensor:
        return self.total().mean()

    def covers(self) -> bool:
        """With an ambient, or with a lobe whose far side, `exp(-2 kappa)`, is no smaller than e^-60."""
        wide = (self.kappa <= 30) & (self.intensity.mean(-1) > 0)
        return bool((self.ambient > 0).any()) or bool(wide.any())

    def proposal(self) -> Proposal:
        """Exact mixture of the lobes and a uniform part for the ambient, by power averaged over the channels."""
        return LightProposal(self, LobesDistribution)

    def breakpoints(self) -> tuple[list[float], list[float]]:
        """The peaks, and multiples of 1/sqrt(kappa) on both sides of each lobe with kappa > 10."""
        self.single_frame()
        thetas: list[float] = []
        phis: list[float] = []
        for mu, kappa, power in zip(
            self.to_fibre_means(), self.kappa.tolist(), self.intensity.sum(-1).tolist(), strict=True
        ):
            if power > 0 and kappa > 0:
                steps = (1.0, 2.5, 5.0, 10.0, 40.0) if kappa > 10 else ()
                more = around(mu, max(kappa, 1e-3) ** -0.5, steps)
                thetas, phis = thetas + more[0], phis + more[1]
        return tidy(thetas, phis)


class LobesDistribution(LightDistribution):
    """p = sum_k P_k C(kappa_k) exp(kappa_k (w . mu_k - 1)) + P_0 / (4 pi), P by the mean power of the channels.

    Uniforms: which lobe, inclination to its axis, azimuth around it.
    """

    dimension = 3
    light: VonMisesFisherLights

    def __init__(self, light: VonMisesFisherLights, context: Context) -> None:
        super().__init__(light, context)
        power = torch.cat([light.intensity.mean(-1), 4 * math.pi * light.ambient.mean().reshape(1)])
        self.share = power / power.sum()

    def sample(self, u: Tensor) -> Tensor:
        u = check_uniforms(u, self.dimension, self.batch_shape)
        light, dtype = self.light, u.dtype
        edges = torch.cumsum(self.share.detach().to(torch.float64), 0)
        last = int(self.share.detach().nonzero().max())
        index = torch.searchsorted(edges, u[..., 0].detach().to(torch.float64).contiguous(), right=True).clamp_max(last)
        mu = light.to_fibre_means().to(u)
        # The ambient is a last lobe with kappa = 0: a uniform direction whatever its axis.
        mu = torch.cat([mu, mu[..., :1, :]], dim=-2)
        kappa = torch.cat([light.kappa.to(u), torch.zeros(1, dtype=dtype, device=u.device)])[index]
        if mu.dim() == 2:
            axis = mu[index]
        else:
            axis = mu.expand(*u.shape[:-1], *mu.shape[-2:]).gather(
                -2, index[..., None, None].expand(*index.shape, 1, 3)
            )
            axis = axis.squeeze(-2)
        safe = kappa.clamp_min(1e-20)  # the formula is exact down to there; at 0 it is 0/0
        # w = 1 - cos(angle to the axis): inverse CDF of exp(-kappa w) on [0, 2].
        # By the smaller of u and 1 - u where that matters, so that the far side keeps the digits of the uniform too.
        v = u[..., 1]
        upper = (v > 0.5) & (safe > 1)
        below = torch.log1p(torch.where(upper, 0.5, v) * torch.expm1(-2 * safe))
        w = (-torch.where(upper, torch.log((1 - v) + v * torch.exp(-2 * safe)), below) / safe).clamp(0.0, 2.0)
        sine = torch.sqrt((w * (2 - w)).clamp_min(torch.finfo(dtype).tiny))
        psi = 2 * math.pi * u[..., 2]
        first, second = orthonormal(axis)
        offset = torch.cos(psi).unsqueeze(-1) * first + torch.sin(psi).unsqueeze(-1) * second
        return to_angles((1 - w).unsqueeze(-1) * axis + sine.unsqueeze(-1) * offset)

    def log_prob(self, omega: Tensor) -> Tensor:
        check_directions(omega, self.batch_shape)
        shapes = self.light.log_shapes(omega)
        logs = torch.cat([shapes, torch.full_like(shapes[..., :1], -math.log(4 * math.pi))], dim=-1)
        kept = self.share > 0
        return torch.logsumexp(logs[..., kept] + torch.log(self.share[kept]).to(omega), dim=-1)


def orthonormal(axis: Tensor) -> tuple[Tensor, Tensor]:
    """Two unit vectors that complete `axis [..., 3]` to a right-handed frame (Duff et al., JCGT 6(1), 2017)."""
    x, y, z = axis.unbind(-1)
    sign = torch.where(z < 0, -1.0, 1.0).to(axis.dtype)
    a = -1 / (sign + z)
    b = x * y * a
    first = torch.stack([1 + sign * x * x * a, sign * b, -sign * x], dim=-1)
    return first, torch.stack([b, sign + y * y * a, -y], dim=-1)
