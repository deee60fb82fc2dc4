"""F cos(theta_i) of the dual scattering BSDF in float32, from closed forms, records and averages (eqs 4-10)."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from dsfit.bsdf.forward import event_count, log_transmittance
from dsfit.frame import HALF_PI
from dsfit.kernels.geometry import Direction, Records, take
from dsfit.kernels.layout import Layout


class Constants:
    """The fibre's numbers, unpacked from one tensor, so that compiled code serves every fibre.

    In this order: eta, c_M, c_M d_b 2/pi, log of what F_scatter is multiplied by, factor of back scattering inside
    F_scatter, alpha [3], beta^2 [3], sigma_a [C].
    """

    def __init__(self, values: Tensor) -> None:
        self.eta, self.lobe, self.back, self.log_density, self.back_factor = values[:5].unbind()
        self.alpha, self.variance = values[5:8].unbind(), values[8:11].unbind()
        self.sigma_a = values[11:].unbind()


def evaluate(
    layout: Layout,
    constants: Tensor,
    averages: Tensor,
    context: tuple[Tensor, Tensor, Tensor],
    direction: Direction,
    records: Records,
    theta_i: Tensor,
) -> list[Tensor]:
    """Channels of F cos(theta_i), each `[S, B]`; `context` is theta_r, n, v, each `[B]`."""
    fixed = Constants(constants)
    _, n, v = context
    average = _averages(layout, averages, theta_i)
    offsets = layout.offsets()
    total: list[Tensor | float] = [0.0] * layout.channels
    if layout.direct:
        found = _direct(layout, fixed, average, direction, records, offsets)
        total = [t + v * x for t, x in zip(total, found, strict=True)]
    if layout.scattered:
        found = _scattered(layout, fixed, average, direction, records, offsets, n)
        total = [t + (1 - v) * x for t, x in zip(total, found, strict=True)]
    factor = direction.cos_i / (direction.cos_diff * direction.cos_diff)
    return [x * factor for x in total]


def _averages(layout: Layout, table: Tensor, theta_i: Tensor) -> list[list[Tensor]]:
    """log a_f, beta_f^2, A_b, Delta_b, sigma_b^2 per channel, linear between knots."""
    y = _position(layout, theta_i)
    j = y.to(torch.int32).clamp_max(layout.knots - 2)
    index, x = j.to(torch.int64), y - j.to(y.dtype)
    low, high = table[:-1], table[1:]
    found = []
    for kind in range(5):
        columns = range(kind * layout.channels, (kind + 1) * layout.channels)
        pairs = [(take(low[:, c], index), take(high[:, c], index)) for c in columns]
        found.append([a + (b - a) * x for a, b in pairs])
    return found


def _position(layout: Layout, theta_i: Tensor) -> Tensor:
    """Position among the knots, which are uniform in sign(theta) (1 - sqrt(1 - 2 |theta| / pi))."""
    gap = torch.sqrt((1 - theta_i.abs() * (1 / HALF_PI)).clamp_min(0))
    return (1 + torch.copysign(1 - gap, theta_i)) * ((layout.knots - 1) / 2)


def _gauss(x: Tensor, variance: Tensor, log_scale: Tensor | float = 0.0) -> Tensor:
    """exp(log_scale) g(x; sqrt(variance))."""
    return torch.exp(log_scale - 0.5 * x * x / variance) * torch.rsqrt(variance * (2 * math.pi))


def _back_mask(layout: Layout, direction: Direction, value: Tensor) -> Tensor:
    return torch.where(direction.phi < HALF_PI, value, 0.0) if layout.half_back else value


def _direct(
    layout: Layout, fixed: Constants, average: list[list[Tensor]], at: Direction, records: Records, where: dict
) -> list[Tensor | float]:
    """c_M (sum_p M_p N_p + (2 d_b / pi) A_b g(theta_h - Delta_b; sigma_b)) per channel."""
    total: list[Tensor | float] = [0.0] * layout.channels
    closed = _closed_forms(layout, fixed, at)
    for p, name in enumerate(("R", "TT", "TRT")):
        if name not in layout.direct:
            continue
        lobe = _gauss(at.theta_h - fixed.alpha[p], fixed.variance[p]) * fixed.lobe
        values = closed[name] if name in closed else [records[where[name] + c] for c in range(layout.channels)]
        total = [t + lobe * x for t, x in zip(total, values, strict=True)]
    if "back" in layout.direct:
        for c in range(layout.channels):
            lobe = _gauss(at.theta_h - average[3][c], average[4][c])
            total[c] = total[c] + _back_mask(layout, at, fixed.back * average[2][c] * lobe)
    return total


def _scattered(
    layout: Layout,
    fixed: Constants,
    average: list[list[Tensor]],
    at: Direction,
    records: Records,
    where: dict,
    n: Tensor,
) -> list[Tensor | float]:
    """T_f c_M (sum_p M^G_p N^G_p + (2 d_b / pi) A_b g(theta_h - Delta_b; sqrt(sigma_b^2 + n beta_f^2))) per channel.

    The transmittance joins the exponents, so that nothing overflows or is lost for large n.
    """
    total: list[Tensor | float] = [0.0] * layout.channels
    law = "poisson" if layout.poisson else "power"
    passed = [fixed.log_density + log_transmittance(x, n, law) for x in average[0]]
    wide = [event_count(torch.exp(x), n, law) * y for x, y in zip(average[0], average[1], strict=True)]
    for p, name in enumerate(("R", "TT", "TRT")):
        if name not in layout.scattered:
            continue
        x, start = at.theta_h - fixed.alpha[p], where[f"{name}_scattered"]
        grey = name == "R"
        shared = records[start] if grey else None
        for c in range(layout.channels):
            value = shared if shared is not None else records[start + c]
            lobe = _gauss(x, fixed.variance[p] + wide[c], passed[c])
            total[c] = total[c] + fixed.lobe * lobe * value
    if "back" in layout.scattered:
        for c in range(layout.channels):
            lobe = _gauss(at.theta_h - average[3][c], average[4][c] + wide[c], passed[c])
            value = fixed.back_factor * fixed.back * average[2][c] * lobe
            total[c] = total[c] + _back_mask(layout, at, value)
    return total


def _closed_forms(layout: Layout, fixed: Constants, at: Direction) -> dict[str, list[Tensor]]:
    """N_R and N_TT per channel: their rays have closed forms.

    R leaves by gamma = |phi| / 2: N_R = F cos(phi/2) / 4. TT, with kappa = 1 / eta' and r^2 = 1 + kappa^2 - 2 kappa
    sin(phi/2): sin gamma = cos(phi/2) / r, cos gamma = (sin(phi/2) - kappa) / r, |dh / dphi| = cos gamma cos gamma_t
    (kappa cos gamma + cos gamma_t) / (2 (1 - kappa^2)), N_TT = (1 - F)^2 T |dh / dphi| / 2.
    """
    found: dict[str, list[Tensor]] = {}
    half = at.phi * 0.5
    sine, cosine = torch.sin(half), torch.cos(half).clamp_min(0)
    if "R" in layout.direct:
        reflected = 1 - _transmitted(fixed.eta, at.cos_diff * cosine)
        found["R"] = [reflected * cosine * 0.25] * layout.channels
    if "TT" in layout.direct:
        eta = fixed.eta
        root = torch.sqrt((eta - 1) * (eta + 1) + at.cos_diff * at.cos_diff)
        kappa = at.cos_diff / root
        gap = sine - kappa
        scale = torch.rsqrt(gap * gap + cosine * cosine)
        cos_gamma = (gap * scale).clamp_min(0)
        inner = kappa * cosine * scale
        cos_t = torch.sqrt(((1 - inner) * (1 + inner)).clamp_min(0))
        spread = cos_gamma * cos_t * (kappa * cos_gamma + cos_t) / ((1 - kappa) * (1 + kappa))
        passed = _transmitted(eta, at.cos_diff * cos_gamma)
        common = passed * passed * spread * 0.25
        depth = -2 * cos_t * eta / root
        found["TT"] = [common * torch.exp(depth * sigma) for sigma in fixed.sigma_a]
    return found


def _transmitted(eta: Tensor, cosine: Tensor) -> Tensor:
    """1 - F of a dielectric, from 1 - r^2 = 4 x y / (x + y)^2: no digits are lost at grazing."""
    g = torch.sqrt((eta - 1) * (eta + 1) + cosine * cosine)
    p = eta * eta * cosine
    a, b = cosine + g, p + g
    return 2 * g * (cosine / (a * a) + p / (b * b))
