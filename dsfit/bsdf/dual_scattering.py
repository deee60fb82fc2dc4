"""The dual scattering approximation of hair (Zinke et al. 2008) over Marschner's fibre (2003): the chapter's
equations (4)-(12), (32), (37).
"""

from __future__ import annotations

import dataclasses
import functools
import math
from typing import Any

import torch
from torch import Tensor

from dsfit.arguments import all_finite, check_inside
from dsfit.bsdf import longitudinal
from dsfit.bsdf.averages import Averages, LobeShares, averages_from_shares
from dsfit.bsdf.azimuthal import (
    AZIMUTHAL_MODELS,
    azimuthal,
    azimuthal_constant,
    azimuthal_scattered,
    printed_shapes,
)
from dsfit.bsdf.conventions import Convention
from dsfit.bsdf.fiber import Fiber
from dsfit.bsdf.scattered import simplified_windows
from dsfit.bsdf.tables import AzimuthTable
from dsfit.errors import InputError, as_real, check_broadcast, check_choice, check_finite, check_range, common_dtype
from dsfit.frame import HALF_PI, cos_inclination, theta_diff, theta_half, wrap
from dsfit.special import is_differentiated, log_gauss


class DualScattering:
    """The dual scattering BSDF of one fibre (or a batch of fibres).

    Args:
        fiber: Marschner's parameters.
        d_f: density factor of forward scattering, in [0, 1].
        d_b: density factor of back scattering, in [0, 1].
        azimuthal: "marschner" (exact roots, TRT caustic treated), "raw" (caustic left) or "simplified" (eqs 21, 25).
        convention: "consistent", "printed", or a `Convention`.
        precision: "exact" (1e-9) or "table": N^G from a spline of its exact values, tens of times faster, within 2e-3
            of each lobe's largest value (1e-5 for R and TT) and 1e-5 in integrals. The table holds no gradients for
            the fibre, serves one round fibre, and not the `raw` azimuths, whose N^G has square-root edges.

    All angles are radians, all results `[..., C]` in the dtype of the angles; the fibre is brought to that dtype.
    Everything is differentiable in the angles, n, v, and the fibre's fields. Directions broadcast with the fibre's
    batch shape from the right.

    `phi_h = (phi_i + phi_r)/2` matters to eccentric fibres only.

    Raises:
        InputError: d_f or d_b outside [0, 1], unknown azimuthal model, convention or precision, or a table asked of a
            batch of fibres, of an eccentric fibre, of one that requires gradients, or of `raw` azimuths.
    """

    def __init__(
        self,
        fiber: Fiber,
        d_f: float = 0.7,
        d_b: float = 0.7,
        azimuthal: str = "marschner",
        convention: str | Convention = "consistent",
        precision: str = "exact",
    ) -> None:
        if not isinstance(fiber, Fiber):
            raise InputError("fiber", type(fiber).__name__, "a dsfit Fiber")
        self.fiber = fiber
        self.d_f = check_range("d_f", as_real("d_f", d_f, fiber.dtype), 0.0, 1.0)
        self.d_b = check_range("d_b", as_real("d_b", d_b, fiber.dtype), 0.0, 1.0)
        if self.d_f.ndim or self.d_b.ndim:
            raise InputError("d_f, d_b", (tuple(self.d_f.shape), tuple(self.d_b.shape)), "single numbers")
        self.model = check_choice("azimuthal", azimuthal, AZIMUTHAL_MODELS)
        self.convention = Convention.named(convention)
        self.precision = check_choice("precision", precision, ("exact", "table"))
        single = not fiber.batch_shape and not fiber.requires_grad and fiber.is_round
        if precision == "table" and not (single and azimuthal != "raw"):
            allowed = "'exact' for raw azimuths, for a batch of fibres, an eccentric fibre, or one with gradients"
            raise InputError("precision", precision, allowed)
        self._fibers = {fiber.dtype: fiber}

    @property
    def channels(self) -> int:
        """Number of channels C."""
        return self.fiber.channels

    def replace(self, **changes: Any) -> DualScattering:
        """The same BSDF with some constructor arguments replaced."""
        arguments: dict[str, Any] = {
            "fiber": self.fiber, "d_f": self.d_f, "d_b": self.d_b, "azimuthal": self.model, "convention":
            self.convention,
            "precision": self.precision,
        }  # fmt: skip
        return DualScattering(**{**arguments, **changes})

    def __call__(
        self, theta_i: Tensor, theta_r: Tensor, phi: Tensor, n: Any = 0.0, v: Any = None, *, phi_h: Tensor | None = None
    ) -> Tensor:
        """F cos(theta_i), `[..., C]` (eq 4): what multiplies radiance in the integral over d omega_i.

        consistent: F = v F_direct + (1 - v) F_scatter, F_direct = f_s + d_b f_back(sigma_b^2),
        F_scatter = d_f a_f^n (f_s^G + d_b f_back(sigma_b^2 + n beta_f^2)).

        Args:
            theta_i, theta_r: inclinations of light and viewer.
            phi: relative azimuth phi_r - phi_i.
            n: scattering fibres towards the light, real, >= 0.
            v: directly lit share in [0, 1]; left out, 1 where n = 0 and 0 elsewhere.

        What is multiplied by an exact zero throughout the batch (a share of 0, d_b = 0) is not computed, unless a
        derivative in that share is asked for.
        """
        theta_i, theta_r, phi, n, v = self._inputs(theta_i, theta_r, phi, n, v)
        batch = self.fiber.batch_shape
        shape = torch.broadcast_shapes(theta_i.shape, batch) if batch else theta_i.shape
        total = theta_i.new_zeros(*shape, self.channels)
        both = self.convention.share == "sum"
        whole = both or is_differentiated(v)  # a share of 0 still has a derivative
        lit, unlit = whole or bool((v != 0).any()), whole or bool((v != 1).any())
        average = None if self._no_back and not unlit else self._averages(theta_i, theta_r)
        if lit:
            share = 1.0 if both else v.unsqueeze(-1)
            total = total + share * self._direct(theta_i, theta_r, phi, n, phi_h, average)
        if unlit:
            share = 1.0 if both else (1 - v).unsqueeze(-1)
            total = total + share * self._scatter(theta_i, theta_r, phi, n, phi_h, average)
        return total * cos_inclination(theta_i).unsqueeze(-1)

    def direct(
        self, theta_i: Tensor, theta_r: Tensor, phi: Tensor, n: Any = 0.0, *, phi_h: Tensor | None = None
    ) -> Tensor:
        """F_direct = f_s + d_b f_back (eq 5), `[..., C]`; n matters only where the convention widens back scattering
        always.
        """
        average = None if self._no_back else self._averages(theta_i, theta_r)
        return self._direct(theta_i, theta_r, phi, n, phi_h, average)

    def _direct(
        self, theta_i: Tensor, theta_r: Tensor, phi: Tensor, n: Any, phi_h: Tensor | None, average: Averages | None
    ) -> Tensor:
        """F_direct with averages that are known already; they matter to back scattering alone."""
        value = self.single(theta_i, theta_r, phi, phi_h=phi_h)
        if self._no_back or average is None:
            return value
        widened = self.convention.back_width == "always"
        extra = self._variance_f(average, n, theta_i) if widened else torch.zeros_like(average.a_f)
        return value + self.d_b.to(value.dtype) * self._back(theta_i, theta_r, phi, average, extra)

    def scatter(self, theta_i: Tensor, theta_r: Tensor, phi: Tensor, n: Any, *, phi_h: Tensor | None = None) -> Tensor:
        """F_scatter = T_f (f_s^G + d_b f_back) (eqs 8, 9), `[..., C]`, with T_f = d_f a_f^n (eq 32); not yet
        multiplied by 1 - v.
        """
        return self._scatter(theta_i, theta_r, phi, n, phi_h, self._averages(theta_i, theta_r))

    def _scatter(
        self, theta_i: Tensor, theta_r: Tensor, phi: Tensor, n: Any, phi_h: Tensor | None, average: Averages | None
    ) -> Tensor:
        """F_scatter with averages that are known already."""
        assert average is not None
        variance_f = self._variance_f(average, n, theta_i)
        value = self.single_scattered(theta_i, theta_r, phi, variance_f, phi_h=phi_h)
        if not self._no_back:
            factor = math.pi if self.convention.back_factor == "pi" else 1.0
            back = self._back(theta_i, theta_r, phi, average, variance_f)
            value = value + factor * self.d_b.to(value.dtype) * back
        n = torch.as_tensor(n, dtype=theta_i.dtype, device=theta_i.device)
        return value * self._transmittance(average, n) * self.d_f.to(value.dtype) ** (self.convention.density_power - 1)

    def single(self, theta_i: Tensor, theta_r: Tensor, phi: Tensor, *, phi_h: Tensor | None = None) -> Tensor:
        """f_s = c_M sum_p M_p N_p / cos^2(theta_diff) (eq 6), `[..., C]`, per steradian."""
        diff = theta_diff(theta_i, theta_r)
        shape = longitudinal.lobes(self._fiber(theta_i.dtype), theta_half(theta_i, theta_r)).unsqueeze(-1)
        return (shape * self.azimuthal(diff, phi, phi_h=phi_h)).sum(-2) * self._projection(diff)

    def single_scattered(
        self, theta_i: Tensor, theta_r: Tensor, phi: Tensor, variance_f: Tensor, *, phi_h: Tensor | None = None
    ) -> Tensor:
        """f_s^G = c_M sum_p M^G_p N^G_p / cos^2(theta_diff) (eq 9), `[..., C]`, for sigma_f^2 `[..., C]`."""
        diff = theta_diff(theta_i, theta_r)
        shape = longitudinal.scattered_lobes(self._fiber(theta_i.dtype), theta_half(theta_i, theta_r), variance_f)
        return (shape * self.azimuthal_scattered(diff, phi, phi_h=phi_h)).sum(-2) * self._projection(diff)

    def azimuthal(self, theta_diff: Tensor, phi: Tensor, *, phi_h: Tensor | None = None) -> Tensor:
        """N_R, N_TT, N_TRT at theta_diff and relative azimuth phi, `[..., 3, C]`, per radian."""
        fiber = self._fiber(phi.dtype)
        if self._printed_shapes:
            shape = printed_shapes(fiber, wrap(phi).abs() + 0 * theta_diff)
            return shape.unsqueeze(-1).expand(*shape.shape, self.channels)
        return azimuthal(fiber, theta_diff, phi, phi_h, self.model, self.convention.absorption)

    def azimuthal_scattered(self, theta_diff: Tensor, phi: Tensor, *, phi_h: Tensor | None = None) -> Tensor:
        """N^G_R, N^G_TT, N^G_TRT, `[..., 3, C]`, per radian (eq 11): N averaged over an incident half circle."""
        fiber, constant = self._fiber(phi.dtype), self.convention.scattered_azimuth == "constant"
        angle = torch.zeros_like(phi) if constant else wrap(phi).abs()
        if self._printed_shapes:
            factor = torch.tensor([4.0, 1.0, 4.0], dtype=phi.dtype, device=phi.device) / math.pi
            shape = simplified_windows(fiber, angle + 0 * theta_diff) * factor
            return shape.unsqueeze(-1).expand(*shape.shape, self.channels)
        if constant:
            theta_diff, _ = torch.broadcast_tensors(theta_diff, phi)
            return azimuthal_constant(fiber, theta_diff, phi_h, self.model, self.convention.absorption)
        if self.precision == "table":
            return self._scattered_table(theta_diff, angle)
        return azimuthal_scattered(fiber, theta_diff, angle, phi_h, self.model, self.convention.absorption)

    @functools.cached_property
    def _scattered_table(self) -> AzimuthTable:
        fiber, absorption = self._fiber(torch.float64), self.convention.absorption
        return AzimuthTable(lambda diff, phi: azimuthal_scattered(fiber, diff, phi, None, self.model, absorption))

    def averages(self, theta_in: Tensor) -> Averages:
        """a_f, a_b, alpha, beta, A_b, Delta_b, sigma_b at inclination theta_in, each `[..., C]` (Zinke et al. 2008,
        eqs 6, 12-17).

        From raw attenuation integrals over offsets, whatever the azimuthal model: the averages count energy, which
            the treatment of the
        caustic only moves.
        """
        fiber, dtype = self._fiber(torch.float64), theta_in.dtype
        front, back = self.lobe_shares(theta_in.to(torch.float64))  # 1 - a_f^2 cancels: round at the end
        average = averages_from_shares(fiber, self.convention, front, back, self.d_b.to(torch.float64))
        return Averages(*(getattr(average, field.name).to(dtype) for field in dataclasses.fields(Averages)))

    def lobe_shares(self, theta_in: Tensor) -> tuple[Tensor, Tensor]:
        """Forward and backward shares a_f^p, a_b^p of R, TT, TRT at theta_in, each `[..., 3, C]`; a_f and a_b are
        their sums.
        """
        fiber, dtype = self._fiber(torch.float64), theta_in.dtype
        theta_in = theta_in.to(torch.float64)  # panels next to grazing are narrower than float32 can tell
        if not fiber.batch_shape:
            return tuple(x.to(dtype) for x in self._shares(theta_in))  # type: ignore[return-value]
        shape = torch.broadcast_shapes(theta_in.shape, fiber.batch_shape)
        which = torch.arange(math.prod(fiber.batch_shape)).reshape(fiber.batch_shape).expand(shape)
        theta = theta_in.expand(shape)
        parts = []
        for half in range(2):
            value = theta.new_zeros(*shape, 3, self.channels)
            for k, table in enumerate(self._shares_of_batch):
                here = which == k
                value = value.index_put((here,), table(theta[here])[half])
            parts.append(value.to(dtype))
        return parts[0], parts[1]

    def transmittance(self, theta_in: Tensor, n: Tensor) -> Tensor:
        """T_f(n, theta_in) = d_f a_f(theta_in)^n (eq 32), `[..., C]`; right for n = 0 and for huge n."""
        n = torch.as_tensor(n, dtype=theta_in.dtype, device=theta_in.device)
        return self._transmittance(self.averages(theta_in), n)

    def back_scattering(self, theta_i: Tensor, theta_r: Tensor, phi: Tensor, variance_f: Any = 0.0) -> Tensor:
        """f_back = 2 c_M A_b g(theta_h - Delta_b; sqrt(sigma_b^2 + sigma_f^2)) / (pi cos^2 theta_diff) (eq 7), `[...,
        C]`.
        """
        average = self._averages(theta_i, theta_r)
        return self._back(theta_i, theta_r, phi, average, variance_f + torch.zeros_like(average.a_f))

    def _back(self, theta_i: Tensor, theta_r: Tensor, phi: Tensor, average: Averages, variance_f: Tensor) -> Tensor:
        diff = theta_diff(theta_i, theta_r)
        center = theta_half(theta_i, theta_r)
        if self.convention.back_argument == "theta_diff+theta_r":
            center = diff + theta_r
        std = torch.sqrt(average.sigma_b**2 + variance_f)
        lobe = 2 * average.A_b * torch.exp(log_gauss(center.unsqueeze(-1) - average.delta_b, std))
        value = lobe * self._projection(diff)
        if self.convention.inverse_cos2:
            value = value / math.pi
        if self.convention.back_azimuth == "back":
            value = torch.where((wrap(phi).abs() < HALF_PI).unsqueeze(-1), value, 0.0)
        return value

    def _projection(self, diff: Tensor) -> Tensor:
        """c_M / cos^2(theta_diff), or c_M alone where the convention drops the cosines; `[..., 1]`."""
        factor = self.convention.lobe_constant
        if not self.convention.inverse_cos2:
            return torch.full_like(diff, factor).unsqueeze(-1)
        return (factor / cos_inclination(diff) ** 2).unsqueeze(-1)

    def _transmittance(self, average: Averages, n: Tensor) -> Tensor:
        base = average.a_f.clamp_min(torch.finfo(average.a_f.dtype).tiny)  # 0^n has no derivative in n
        return self.d_f.to(n.dtype) * torch.pow(base, n.unsqueeze(-1))

    def _variance_f(self, average: Averages, n: Any, like: Tensor) -> Tensor:
        """sigma_f^2 = n beta_f^2, `[..., C]`."""
        return torch.as_tensor(n, dtype=like.dtype, device=like.device).unsqueeze(-1) * average.beta_f**2

    def _average_angle(self, theta_i: Tensor, theta_r: Tensor) -> Tensor:
        return theta_i if self.convention.average_angle == "theta_in" else theta_diff(theta_i, theta_r)

    def _averages(self, theta_i: Tensor, theta_r: Tensor) -> Averages:
        return self.averages(self._average_angle(theta_i, theta_r))

    @property
    def _no_back(self) -> bool:
        """Whether back scattering is multiplied by a zero that nobody asks a derivative of."""
        return bool(self.d_b == 0) and not is_differentiated(self.d_b)

    @property
    def _printed_shapes(self) -> bool:
        return self.model == "simplified" and self.convention.simplified_energy == "printed"

    def _inputs(self, theta_i: Any, theta_r: Any, phi: Any, n: Any, v: Any) -> tuple[Tensor, ...]:
        dtype, device = common_dtype("dtype", None, (theta_i, theta_r, phi, n, v, self.fiber.eta))
        names = {"theta_i": theta_i, "theta_r": theta_r, "phi": phi, "n": n, "v": v}
        values = {k: as_real(k, x, dtype, device) for k, x in names.items() if k != "v" or v is not None}
        if v is None:
            values["v"] = (values["n"] == 0).to(dtype)
        check_broadcast(**values)
        for name in ("theta_i", "theta_r", "phi"):
            if not all_finite(values[name]):
                check_finite(name, values[name])
        check_inside("n", values["n"], 0.0, math.inf)
        check_inside("v", values["v"], 0.0, 1.0)
        return torch.broadcast_tensors(*values.values())

    def _fiber(self, dtype: torch.dtype) -> Fiber:
        if dtype not in self._fibers:
            self._fibers[dtype] = self.fiber.to(dtype)
        return self._fibers[dtype]

    def _tables(self, fiber: Fiber) -> LobeShares:
        return LobeShares(fiber, self.convention)

    @property
    def _shares(self) -> LobeShares:
        if self.fiber.requires_grad:  # a graph serves one backward pass
            return self._tables(self._fiber(torch.float64))
        return self._cached_shares

    @functools.cached_property
    def _cached_shares(self) -> LobeShares:
        return self._tables(self._fiber(torch.float64))

    @property
    def _shares_of_batch(self) -> list[LobeShares]:
        if self.fiber.requires_grad:
            return self._build_batch()
        return self._cached_batch

    @functools.cached_property
    def _cached_batch(self) -> list[LobeShares]:
        return self._build_batch()

    def _build_batch(self) -> list[LobeShares]:
        fiber, shape = self._fiber(torch.float64), self.fiber.batch_shape
        rows = {
            name: value.expand(*shape, *value.shape[-1:]).reshape(-1, value.shape[-1])
            if name in ("sigma_a", "alpha", "beta")
            else value.expand(shape).reshape(-1)
            for name, value in fiber.parameters().items()
        }
        return [self._tables(Fiber(**{k: x[i] for k, x in rows.items()})) for i in range(math.prod(shape))]
