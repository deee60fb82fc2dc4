"""Average attenuation and lobe statistics of one scattering event, over both hemispheres, as functions of theta_in."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from dsfit.bsdf.attenuation import forward_backward_energies, lobe_energies
from dsfit.bsdf.backscatter import back_shift, back_width, backscatter_albedo
from dsfit.bsdf.conventions import Convention
from dsfit.bsdf.fiber import Fiber
from dsfit.bsdf.scattered import offset_windows
from dsfit.bsdf.snell import Refraction
from dsfit.frame import HALF_PI, cos_inclination
from dsfit.quadrature import PiecewiseChebyshev, graded_ends, merge_breaks, panel_points

_ORIENTATION_NODES = 12
_JUMPS = (math.sqrt(2.0), 2.0)  # eta' at which the way of TRT changes
_EDGES = (1 / math.sin(math.pi / 8), 1 / math.sin(3 * math.pi / 8))  # eta' at which its edge crosses phi = +-pi/2


@dataclass(frozen=True)
class Averages:
    """Averages at an inclination theta_in, each `[..., C]` (Zinke et al. 2008, eqs 6, 12-17).

    Attributes:
        a_f, a_b: average forward and backward attenuation.
        alpha_f, alpha_b: average longitudinal shift of forward and backward scattering, radians.
        beta_f, beta_b: average longitudinal standard deviation, radians.
        A_b: backward attenuation of the surrounding hair, A_1 + A_3.
        delta_b: average longitudinal shift of back scattering.
        sigma_b: standard deviation of back scattering.

    Example:
        >>> import torch
        >>> import dsfit
        >>> bsdf = dsfit.DualScattering(dsfit.Fiber.preset("nonabsorbing"))
        >>> averages = bsdf.averages(torch.tensor(0.0, dtype=torch.float64))
        >>> round(float(averages.a_f[0]), 4), round(float(averages.a_b[0]), 4)
        (0.7772, 0.1997)
    """

    a_f: Tensor
    a_b: Tensor
    alpha_f: Tensor
    alpha_b: Tensor
    beta_f: Tensor
    beta_b: Tensor
    A_b: Tensor
    delta_b: Tensor
    sigma_b: Tensor


class LobeShares:
    """Forward and backward share of each lobe, a_f^p and a_b^p, at theta_in.

    With K = c_M g(theta_h - alpha_p; beta_p) cos(theta_in) cos(theta_o) / cos^2(theta_diff), `a_f^p(theta_in) = int K
    [int N_p |phi|/pi dphi] dtheta_o` and a_b^p with 1 - |phi|/pi (Zinke et al. 2008, eqs 6 and 12, reduced). In
    theta_h, `cos(theta_in) cos(theta_o)/cos^2(theta_diff) = 1 - sin^2(theta_h)/cos^2(theta_diff)`, which is bounded by
    1.

    Two nested interpolants make this fast to the last digits: the azimuthal energies as functions of theta_diff, and
        the shares,
    divided by cos(theta_in), as functions of theta_in. Both refine themselves; neither uses Monte Carlo or roots.
    """

    def __init__(self, fiber: Fiber, convention: Convention) -> None:
        if fiber.batch_shape:
            raise ValueError("LobeShares takes one fibre at a time")
        self.fiber, self.convention = fiber, convention
        self._targets = _JUMPS if convention.split == "fraction" else _JUMPS + _EDGES
        self._kinks = self._jumps()
        inner = torch.tensor([0.4, 0.8, 1.2], dtype=self._kinks.dtype)
        breaks = merge_breaks(torch.cat([self._kinks, inner]), 0.0, HALF_PI, 1e-12)
        energies = PiecewiseChebyshev(self._energies_at, breaks, tolerance=1e-12)
        self._energies = [energies.select(lambda c, p=p: self._of_lobe(c, p)) for p in range(3)]
        self._shares = PiecewiseChebyshev(self._scaled_shares_at, self._share_breaks(), tolerance=1e-11, max_depth=8)

    def __call__(self, theta_in: Tensor) -> tuple[Tensor, Tensor]:
        """a_f^p and a_b^p, each `[..., 3, C]`."""
        scaled = self._shares(theta_in)
        scaled = scaled.reshape(*theta_in.shape, 2, 3, self.fiber.channels)
        value = scaled * cos_inclination(theta_in)[..., None, None, None]  # never 0: averages divide by shares
        return value.select(-3, 0), value.select(-3, 1)

    @property
    def series(self) -> PiecewiseChebyshev:
        """The shares over cos(theta_in), 2 x 3 x C components: forward and backward, lobes, channels."""
        return self._shares

    def _jumps(self) -> Tensor:
        """theta_diff where eta' = 2 or eta' = sqrt 2 (or, for a hard split, where the edge of TRT crosses +-pi/2) for a
        principal orientation of the section.

        The TRT share has a jump in its second derivative there, or, for an eccentric section, its average over
        orientations begins to see one.
        """
        points = []
        for angle in (0.0, math.pi / 2):
            eta = self.fiber.eta_trt(torch.tensor(angle, dtype=self.fiber.dtype)).detach()
            for target in self._targets:
                cos2 = (eta**2 - 1) / (target * target - 1)
                if 0.0 < float(cos2) < 1.0:
                    points.append(torch.acos(torch.sqrt(cos2)).reshape(()))
        return torch.stack(points) if points else torch.zeros(0, dtype=self.fiber.dtype)

    def _energies_at(self, theta_diff: Tensor) -> Tensor:
        fiber = self.fiber
        plain = Refraction.at(fiber.eta, theta_diff)
        energies = self._split((plain, plain, plain))
        if not fiber.is_round:
            phi_h, weight = self._orientations(theta_diff)
            bent = Refraction.at(fiber.eta_trt(phi_h), theta_diff[:, None])
            turned = (self._split((bent, bent, bent))[..., 2:, :] * weight[..., None, None, None]).sum(1)
            energies = torch.cat([energies[..., :2, :], turned], dim=-2)
        return energies.flatten(1)

    def _orientations(self, theta_diff: Tensor) -> tuple[Tensor, Tensor]:
        """phi_h and weights `[M, nodes]` of the average over orientations, split where eta' crosses 2 and sqrt 2."""
        low, high = (self.fiber.eta_trt(torch.tensor(a, dtype=theta_diff.dtype)).detach() for a in (math.pi / 2, 0.0))
        sin2, cos2 = torch.sin(theta_diff) ** 2, torch.cos(theta_diff) ** 2
        cuts = [torch.zeros_like(sin2), torch.full_like(sin2, math.pi / 2)]
        for target in self._targets:
            cosine = (2 * torch.sqrt(sin2 + target**2 * cos2) - high - low) / (high - low)
            cuts.append(torch.acos(cosine.clamp(-1.0, 1.0)) / 2)
        nodes, weight = panel_points(torch.sort(torch.stack(cuts, dim=-1), dim=-1).values, _ORIENTATION_NODES)
        return nodes, weight * (2 / math.pi)

    def _of_lobe(self, columns: Tensor, p: int) -> Tensor:
        return columns.unflatten(-1, (2, 3, self.fiber.channels))[..., p, :].flatten(-2)

    def _split(self, bent: tuple[Refraction, ...]) -> Tensor:
        """Forward and backward azimuthal energy, `[..., 2, 3, C]`."""
        fiber, absorption = self.fiber, self.convention.absorption
        if self.convention.split == "fraction":
            front, back = forward_backward_energies(bent, fiber.sigma_a, absorption)
        else:
            total = lobe_energies(bent, fiber.sigma_a, absorption)
            phi = torch.full_like(bent[0].kappa, math.pi)
            front = offset_windows(fiber, bent, phi, "raw", absorption)
            back = total - front
        return torch.stack([front, back], dim=-3)

    def _share_breaks(self) -> Tensor:
        """Break points in theta_in: where a lobe leaves the reachable set, where it meets the kink at eta' = 2, and
        the ends.
        """
        fiber = self.fiber
        alpha, beta = fiber.alpha.detach(), fiber.beta.detach()
        offsets = torch.tensor([-9.0, -4.0, 0.0, 4.0, 9.0], dtype=alpha.dtype)
        kinks = self._kinks
        centers = [2 * alpha - HALF_PI, 2 * alpha + HALF_PI]
        widths = [2 * beta, 2 * beta]
        for kink in kinks:
            centers += [alpha - kink, alpha + kink]
            widths += [beta, beta]
        points = torch.stack(centers)[..., None] + torch.stack(widths)[..., None] * offsets
        ends = torch.tensor(graded_ends(-HALF_PI, HALF_PI, levels=20), dtype=alpha.dtype)
        return merge_breaks(torch.cat([points.flatten(), ends]), -HALF_PI, HALF_PI, 1e-9)

    def _scaled_shares_at(self, theta_in: Tensor) -> Tensor:
        parts = [self._lobe_at(p, theta_in) for p in range(3)]
        return torch.stack(parts, dim=2).flatten(1)

    def _lobe_at(self, p: int, theta_in: Tensor) -> Tensor:
        """a^p / cos(theta_in), `[M, 2, C]`, by composite Gauss-Legendre in theta_h on panels that follow the lobe and
        the kinks.
        """
        fiber = self.fiber
        alpha, beta = fiber.alpha[p], fiber.beta[p]
        low, high = theta_in / 2 - math.pi / 4, theta_in / 2 + math.pi / 4
        steps = torch.tensor([-8.5, -4.5, -1.5, 1.5, 4.5, 8.5], dtype=theta_in.dtype)
        around = (alpha.detach() + beta.detach() * steps).expand(len(theta_in), -1)
        kinks = self._kinks
        crossing = torch.cat([theta_in[:, None] + kinks, theta_in[:, None] - kinks, theta_in[:, None]], dim=1)
        # near grazing the factor 1/cos^2(theta_diff) is a boundary layer at the end of the interval: geometric panels
        # there, of a ratio that 10 nodes resolve to 1e-13 wherever the layer is, down to a quarter of its thickness
        grade = torch.tensor([0.4**k for k in range(1, 20)], dtype=theta_in.dtype) * HALF_PI
        grade = torch.maximum(grade, (HALF_PI - theta_in.detach().abs())[:, None] / 8)
        layers = torch.cat([low[:, None] + grade, high[:, None] - grade], dim=1)
        breaks = torch.cat([low[:, None], high[:, None], around, crossing, layers], dim=1)
        near = torch.maximum(low, torch.minimum(high, around[:, 0]))[:, None]
        far = torch.minimum(high, torch.maximum(low, around[:, -1]))[:, None]
        breaks = torch.sort(torch.minimum(torch.maximum(breaks, near), far), dim=1).values
        theta_h, weight = panel_points(breaks.detach(), 10)
        theta_o = 2 * theta_h - theta_in[:, None]
        theta_diff = theta_h - theta_in[:, None]
        used = weight > 0
        energies = theta_h.new_zeros(*theta_h.shape, 2, fiber.channels)
        flat = self._energies[p](theta_diff[used].abs()).reshape(-1, 2, fiber.channels)
        energies = energies.index_put((used,), flat)
        gauss = torch.exp(-0.5 * ((theta_h - alpha) / beta) ** 2) / (beta * math.sqrt(2 * math.pi))
        outgoing = torch.cos(theta_o).clamp_min(0.0) / torch.cos(theta_diff).clamp_min(1e-150) ** 2
        if self.convention.average_weight == "outgoing":
            outgoing = outgoing * torch.cos(theta_o) / torch.cos(theta_in).clamp_min(1e-150)[:, None]
        kernel = torch.where(used, 2 * self.convention.lobe_constant * gauss * weight * outgoing, 0.0)
        return torch.einsum("mq,mqsc->msc", kernel, energies)


def averages_from_shares(fiber: Fiber, convention: Convention, front: Tensor, back: Tensor, d_b: Tensor) -> Averages:
    """All averages from the lobes' forward and backward shares `[..., 3, C]`.

    a_f = sum_p a_f^p; alpha_f = sum_p a_f^p alpha_p / a_f; beta_f^2 = sum_p a_f^p beta_p^2 / a_f (or beta_f by
    beta_p); likewise backward. Where all shares underflow, as for narrow lobes that leave the reachable inclinations,
    shifts and widths are plain means.
    """
    a_f, a_b = _over_lobes(front), _over_lobes(back)
    tiny = torch.finfo(a_f.dtype).tiny
    alpha, beta = fiber.alpha.unsqueeze(-1), fiber.beta.unsqueeze(-1)

    def mean(share: Tensor, value: Tensor) -> Tensor:
        weight = share + tiny**0.5
        return _over_lobes(weight * value) / _over_lobes(weight)

    if convention.mean_width == "variance":
        beta_f, beta_b = (torch.sqrt(mean(share, beta**2)) for share in (front, back))
    else:
        beta_f, beta_b = mean(front, beta), mean(back, beta)
    alpha_f, alpha_b = mean(front, alpha), mean(back, alpha)
    if convention.limit_energy:
        total = (a_f + a_b).clamp_min(1.0)
        a_f, a_b = a_f / total, a_b / total
    return Averages(
        a_f=a_f,
        a_b=a_b,
        alpha_f=alpha_f,
        alpha_b=alpha_b,
        beta_f=beta_f,
        beta_b=beta_b,
        A_b=backscatter_albedo(a_f, a_b),
        delta_b=back_shift(a_f, a_b, alpha_f, alpha_b, convention.shift_sign),
        sigma_b=back_width(a_f, a_b, beta_f, beta_b, d_b),
    )


def _over_lobes(value: Tensor) -> Tensor:
    """Sum over the last dimension but one; several times faster than torch's for three lobes of a few channels."""
    first, second, third = value.unbind(-2)
    return first + second + third
