"""The dual scattering approximation of hair (Zinke et al. 2008) over Marschner's fibre (2003): the chapter's
equations (4)-(12), (32), (37).
"""

from __future__ import annotations

import functools
import math
from typing import Any

import torch
from torch import Tensor

from dsfit.arguments import all_finite, check_inside
from dsfit.bsdf import forward, longitudinal
from dsfit.bsdf.averages import Averages
from dsfit.bsdf.azimuthal import (
    ALL_LOBES,
    AZIMUTHAL_MODELS,
    azimuthal,
    azimuthal_constant,
    azimuthal_scattered,
    printed_shapes,
)
from dsfit.bsdf.conventions import Convention
from dsfit.bsdf.fiber import Fiber
from dsfit.bsdf.fiber_averages import FiberAverages
from dsfit.bsdf.grey import first_channel, one_channel
from dsfit.bsdf.scattered import simplified_windows
from dsfit.bsdf.tables import AzimuthTable
from dsfit.bsdf.terms import Terms
from dsfit.errors import InputError, as_real, check_broadcast, check_choice, check_finite, check_range, common_dtype
from dsfit.frame import HALF_PI, cos_inclination, theta_diff, theta_half, wrap
from dsfit.special import is_differentiated, log_gauss


class DualScattering(FiberAverages):
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
        terms: which terms of F are computed; all, if left out. `azimuthal`, `azimuthal_scattered` and `averages` give
            every lobe whatever the terms.

    All angles are radians, all results `[..., C]` in the dtype of the angles; the fibre is brought to that dtype.
    Everything is differentiable in the angles, n, v, and the fibre's fields. Directions broadcast with the fibre's
    batch shape from the right.

    `phi_h = (phi_i + phi_r)/2` matters to eccentric fibres only.

    Raises:
        InputError: d_f or d_b outside [0, 1], unknown azimuthal model, convention or precision, a table asked of a
            batch of fibres, of an eccentric fibre, of one that requires gradients, or of `raw` azimuths, or grey terms
            of a fibre that is not grey.

    Example:
        >>> import torch
        >>> import dsfit
        >>> bsdf = dsfit.DualScattering(dsfit.Fiber.preset("brown"))
        >>> theta_i, theta_r, phi = torch.tensor([0.2, -0.3, 0.5], dtype=torch.float64)
        >>> [f"{x:.4f}" for x in bsdf(theta_i, theta_r, phi, n=0.0, v=1.0).tolist()]
        ['0.0229', '0.0190', '0.0160']
    """

    def __init__(
        self,
        fiber: Fiber,
        d_f: float = 0.7,
        d_b: float = 0.7,
        azimuthal: str = "marschner",
        convention: str | Convention = "consistent",
        precision: str = "exact",
        terms: Terms | None = None,
    ) -> None:
        if not isinstance(fiber, Fiber):
            raise InputError("fiber", type(fiber).__name__, "a dsfit Fiber")
        d_f, d_b = (check_range(k, as_real(k, x, fiber.dtype), 0.0, 1.0) for k, x in (("d_f", d_f), ("d_b", d_b)))
        if d_f.ndim or d_b.ndim:
            raise InputError("d_f, d_b", (tuple(d_f.shape), tuple(d_b.shape)), "single numbers")
        self.model = check_choice("azimuthal", azimuthal, AZIMUTHAL_MODELS)
        super().__init__(fiber, d_b, Convention.named(convention))
        self.d_f = d_f
        self.precision = check_choice("precision", precision, ("exact", "table"))
        single = not fiber.batch_shape and not fiber.requires_grad and fiber.is_round
        if precision == "table" and not (single and azimuthal != "raw"):
            allowed = "'exact' for raw azimuths, for a batch of fibres, an eccentric fibre, or one with gradients"
            raise InputError("precision", precision, allowed)
        if terms is not None and not isinstance(terms, Terms):
            raise InputError("terms", type(terms).__name__, "dsfit Terms")
        self.terms = Terms() if terms is None else terms
        self._selected: dict[tuple[int, ...], AzimuthTable] = {}
        self._grey = None
        if self.terms.grey and fiber.channels > 1:
            self._grey = self.replace(fiber=first_channel(fiber))

    def replace(self, **changes: Any) -> DualScattering:
        """The same BSDF with some constructor arguments replaced."""
        arguments: dict[str, Any] = {
            "fiber": self.fiber, "d_f": self.d_f, "d_b": self.d_b, "azimuthal": self.model, "convention":
            self.convention,
            "precision": self.precision, "terms": self.terms,
        }  # fmt: skip
        other = DualScattering(**{**arguments, **changes})
        if set(changes) == {"terms"}:  # tables do not depend on them
            other.origin = self.origin
        return other

    @one_channel
    def __call__(
        self, theta_i: Tensor, theta_r: Tensor, phi: Tensor, n: Any = 0.0, v: Any = None, *, phi_h: Tensor | None = None
    ) -> Tensor:
        """F cos(theta_i), `[..., C]` (eq 4): what multiplies radiance in the integral over d omega_i.

        consistent: F = v F_direct + (1 - v) F_scatter, F_direct = f_s + d_b f_back(sigma_b^2),
        F_scatter = d_f a_f^n (f_s^G + d_b f_back(sigma_b^2 + n beta_f^2)); with `transmittance="poisson"` the a_f^n and
        n beta_f^2 of a Poisson number of fibres (`dsfit.bsdf.forward`).

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
        lit = bool(self.terms.direct) and (whole or bool((v != 0).any()))
        unlit = bool(self.terms.scattered) and (whole or bool((v != 1).any()))
        average = self._averages(theta_i, theta_r) if unlit or (lit and self._backs("direct")) else None
        if lit:
            share = 1.0 if both else v.unsqueeze(-1)
            total = total + share * self._direct(theta_i, theta_r, phi, n, phi_h, average)
        if unlit:
            share = 1.0 if both else (1 - v).unsqueeze(-1)
            total = total + share * self._scatter(theta_i, theta_r, phi, n, phi_h, average)
        return total * cos_inclination(theta_i).unsqueeze(-1)

    @one_channel
    def direct(
        self, theta_i: Tensor, theta_r: Tensor, phi: Tensor, n: Any = 0.0, *, phi_h: Tensor | None = None
    ) -> Tensor:
        """F_direct = f_s + d_b f_back (eq 5), `[..., C]`; n matters only where the convention widens back scattering
        always.
        """
        average = self._averages(theta_i, theta_r) if self._backs("direct") else None
        return self._direct(theta_i, theta_r, phi, n, phi_h, average)

    def _direct(
        self, theta_i: Tensor, theta_r: Tensor, phi: Tensor, n: Any, phi_h: Tensor | None, average: Averages | None
    ) -> Tensor:
        """F_direct with averages that are known already; they matter to back scattering alone."""
        value = self.single(theta_i, theta_r, phi, phi_h=phi_h)
        if average is None or not self._backs("direct"):
            return value
        widened = self.convention.back_width == "always"
        extra = self._variance_f(average, n, theta_i) if widened else torch.zeros_like(average.a_f)
        return value + self.d_b.to(value.dtype) * self._back(theta_i, theta_r, phi, average, extra)

    @one_channel
    def scatter(self, theta_i: Tensor, theta_r: Tensor, phi: Tensor, n: Any, *, phi_h: Tensor | None = None) -> Tensor:
        """F_scatter = T_f (f_s^G + d_b f_back) (eqs 8, 9), `[..., C]`, with T_f of `transmittance`; not yet
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
        if self._backs("scattered"):
            factor = math.pi if self.convention.back_factor == "pi" else 1.0
            back = self._back(theta_i, theta_r, phi, average, variance_f)
            value = value + factor * self.d_b.to(value.dtype) * back
        n = torch.as_tensor(n, dtype=theta_i.dtype, device=theta_i.device)
        return value * self._transmittance(average, n) * self.d_f.to(value.dtype) ** (self.convention.density_power - 1)

    @one_channel
    def single(self, theta_i: Tensor, theta_r: Tensor, phi: Tensor, *, phi_h: Tensor | None = None) -> Tensor:
        """f_s = c_M sum_p M_p N_p / cos^2(theta_diff) (eq 6), `[..., C]`, per steradian."""
        diff, lobes = theta_diff(theta_i, theta_r), self.terms.direct_lobes
        if not lobes:
            return self._nothing(diff)
        shape = longitudinal.lobes(self._fiber(theta_i.dtype), theta_half(theta_i, theta_r), lobes).unsqueeze(-1)
        value = self.azimuthal(diff, phi, phi_h=phi_h, **_chosen(lobes))
        return (shape * value).sum(-2) * self._projection(diff)

    @one_channel
    def single_scattered(
        self, theta_i: Tensor, theta_r: Tensor, phi: Tensor, variance_f: Tensor, *, phi_h: Tensor | None = None
    ) -> Tensor:
        """f_s^G = c_M sum_p M^G_p N^G_p / cos^2(theta_diff) (eq 9), `[..., C]`, for sigma_f^2 `[..., C]`."""
        diff, lobes = theta_diff(theta_i, theta_r), self.terms.scattered_lobes
        if not lobes:
            return self._nothing(diff)
        fiber = self._fiber(theta_i.dtype)
        shape = longitudinal.scattered_lobes(fiber, theta_half(theta_i, theta_r), variance_f, lobes)
        value = self.azimuthal_scattered(diff, phi, phi_h=phi_h, **_chosen(lobes))
        return (shape * value).sum(-2) * self._projection(diff)

    @one_channel
    def azimuthal(
        self, theta_diff: Tensor, phi: Tensor, *, phi_h: Tensor | None = None, lobes: tuple[int, ...] = ALL_LOBES
    ) -> Tensor:
        """N_R, N_TT, N_TRT (those of `lobes`, 0 to 2) at theta_diff and relative azimuth phi, `[..., len(lobes), C]`,
        per radian.
        """
        fiber = self._fiber(phi.dtype)
        if self._printed_shapes:
            shape = printed_shapes(fiber, wrap(phi).abs() + 0 * theta_diff)[..., list(lobes)]
            return shape.unsqueeze(-1).expand(*shape.shape, self.channels)
        return azimuthal(fiber, theta_diff, phi, phi_h, self._azimuths, self.convention.absorption, lobes)

    @one_channel
    def azimuthal_scattered(
        self, theta_diff: Tensor, phi: Tensor, *, phi_h: Tensor | None = None, lobes: tuple[int, ...] = ALL_LOBES
    ) -> Tensor:
        """N^G_R, N^G_TT, N^G_TRT (those of `lobes`), `[..., len(lobes), C]`, per radian (eq 11): N averaged over an
        incident half circle.
        """
        fiber, constant = self._fiber(phi.dtype), self.convention.scattered_azimuth == "constant"
        angle = torch.zeros_like(phi) if constant else wrap(phi).abs()
        if self._printed_shapes:
            factor = torch.tensor([4.0, 1.0, 4.0], dtype=phi.dtype, device=phi.device) / math.pi
            shape = (simplified_windows(fiber, angle + 0 * theta_diff) * factor)[..., list(lobes)]
            return shape.unsqueeze(-1).expand(*shape.shape, self.channels)
        if constant:
            theta_diff, _ = torch.broadcast_tensors(theta_diff, phi)
            return azimuthal_constant(fiber, theta_diff, phi_h, self._azimuths, self.convention.absorption, lobes)
        if self.precision == "table":
            return self._table_of(lobes)(theta_diff, angle)
        return azimuthal_scattered(fiber, theta_diff, angle, phi_h, self._azimuths, self.convention.absorption, lobes)

    @functools.cached_property
    def scattered_table(self) -> AzimuthTable:
        """N^G as `precision="table"` has it, whatever the terms."""
        if self.origin is not self:
            return self.origin.scattered_table
        fiber, absorption = self._fiber(torch.float64), self.convention.absorption
        return AzimuthTable(lambda diff, phi: azimuthal_scattered(fiber, diff, phi, None, self.model, absorption))

    def _table_of(self, lobes: tuple[int, ...]) -> AzimuthTable:
        if lobes not in self._selected:
            self._selected[lobes] = self.scattered_table.select(lobes)
        return self._selected[lobes]

    @one_channel
    def transmittance(self, theta_in: Tensor, n: Tensor) -> Tensor:
        """T_f(n, theta_in) = d_f a_f(theta_in)^n (eq 32) or d_f tau, `[..., C]`; right for n = 0 and for huge n."""
        n = torch.as_tensor(n, dtype=theta_in.dtype, device=theta_in.device)
        return self._transmittance(self.averages(theta_in), n)

    @one_channel
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
        passed = forward.transmittance(average.a_f, n.unsqueeze(-1), self.convention.transmittance)
        return self.d_f.to(n.dtype) * passed

    def _variance_f(self, average: Averages, n: Any, like: Tensor) -> Tensor:
        """sigma_f^2 = n beta_f^2, or what a Poisson number of fibres has for n, `[..., C]`."""
        n = torch.as_tensor(n, dtype=like.dtype, device=like.device).unsqueeze(-1)
        return forward.event_count(average.a_f, n, self.convention.transmittance) * average.beta_f**2

    def _average_angle(self, theta_i: Tensor, theta_r: Tensor) -> Tensor:
        return theta_i if self.convention.average_angle == "theta_in" else theta_diff(theta_i, theta_r)

    def _averages(self, theta_i: Tensor, theta_r: Tensor) -> Averages:
        return self.averages(self._average_angle(theta_i, theta_r))

    def _backs(self, half: str) -> bool:
        """Whether F_direct or F_scatter has back scattering: not if it is left out, or multiplied by a zero that nobody
        asks a derivative of."""
        nothing = bool(self.d_b == 0) and not is_differentiated(self.d_b)
        return "back" in getattr(self.terms, half) and not nothing

    def _nothing(self, like: Tensor) -> Tensor:
        batch = self.fiber.batch_shape
        return like.new_zeros(*torch.broadcast_shapes(like.shape, batch), self.channels)

    @property
    def _azimuths(self) -> str:
        """The azimuthal model, raw where the terms leave the treatment of the caustic out."""
        return "raw" if self.model == "marschner" and not self.terms.glint else self.model

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


def _chosen(lobes: tuple[int, ...]) -> dict[str, Any]:
    return {} if lobes == ALL_LOBES else {"lobes": lobes}
