"""The numbers of a header: 16-bit tables with a scale for every row, float32 for the rest."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from dsfit.bsdf.dual_scattering import DualScattering
from dsfit.errors import InputError
from dsfit.export.served import check_exported
from dsfit.frame import HALF_PI
from dsfit.kernels.tables import average_table, law_tables
from dsfit.proposals.amortised import AmortisedProposal
from dsfit.proposals.conditional import FiberAzimuth
from dsfit.proposals.uniform import BackHalf

_TOP = 65535
_FINER = 2
"""Rows of N_TRT and N^G in one row of the laws of azimuth."""
_DEEPEST = 1024.0
"""Deeper rows of the moments are left out: no light passes that many fibres, and energies go on linearly."""
_DIGITS = 7
"""Of the averages: they are looked up between knots that are right to some 1e-6."""
_SMALLEST = 1e-30
_STEPS = (65535, 9999, 9999)
"""Steps in which modes and log widths are told: some 1e-4 of a width."""
ALL, BACK = -1, -2


@dataclass(frozen=True)
class Rows:
    """16-bit numbers `[rows, columns, k]` and what they are multiplied by, float32 `[rows, k]`."""

    values: np.ndarray
    scale: np.ndarray

    def decoded(self) -> np.ndarray:
        """The table, float32."""
        return self.values.astype(np.float32) * self.scale[:, None]


@dataclass(frozen=True)
class Tables:
    """Everything that a header holds, as it is printed. What only shapes the proposal is rounded further than float32:
    density and draws follow from the rounded numbers alike.

    Attributes:
        eta, lobe_constant, back_factor, log_density, scattered_back: c_M, 2 d_b / pi, the logarithm of what F_scatter
            is multiplied by, and the factor of back scattering in it.
        alpha, variance, sigma_a: of the lobes, and absorption.
        half_back: whether back scattering stays in |phi| < pi/2.
        poisson: whether the number of fibres that light meets is Poisson distributed.
        trt: N_TRT over |theta_diff| and |phi|, by channel.
        spread: N^G_R, then N^G_TT and N^G_TRT by channel, |phi| in [0, pi/2]; N^G(phi) + N^G(pi - phi) is twice the
            last column.
        averages: `[knots, 5, C]`, see `kernels.tables.average_table`.
        laws: per tabulated law of |phi| its 16-bit density `[rows, columns]`; every row has a positive one.
        components: the law of each component of the mixture: a number of `laws`, `ALL` or `BACK`.
        near: moments of direct light `[rows, 4, lobes]`; far_energy, far_shape: of scattered light `[rows, depths,
            lobes]`, 16-bit `[rows, depths, 3, lobes]`, of which `shape_start + shape_step k` is meant.
        depths: of the moments.
        layers: biases and weights `[inputs, outputs]` of the network.
        log_lobes: log of 1 - defensive; sphere: defensive / (4 pi).
    """

    eta: float
    lobe_constant: float
    back_factor: float
    log_density: float
    scattered_back: float
    alpha: np.ndarray
    variance: np.ndarray
    sigma_a: np.ndarray
    half_back: bool
    poisson: bool
    trt: Rows
    spread: Rows
    averages: np.ndarray
    laws: tuple[np.ndarray, ...]
    components: tuple[int, ...]
    near: np.ndarray
    far_energy: np.ndarray
    far_shape: np.ndarray
    shape_start: np.ndarray
    shape_step: np.ndarray
    depths: np.ndarray
    layers: tuple[tuple[np.ndarray, np.ndarray], ...]
    log_lobes: float
    sphere: float

    def far(self) -> np.ndarray:
        """Moments of scattered light, float32 `[rows, depths, 4, lobes]`."""
        shape = self.shape_start[:, None] + self.shape_step[:, None] * self.far_shape.astype(np.float32)
        return np.concatenate([self.far_energy[:, :, None], shape], axis=2)

    def law_scale(self) -> np.ndarray:
        """What makes densities of |phi| of the laws, `[laws, rows]` float32."""
        return np.stack([2 * (x.shape[1] - 1) / math.pi / self.law_sums(x, 1)[:, -1] for x in self.laws]).astype("f4")

    @staticmethod
    def law_sums(law: np.ndarray, stride: int) -> np.ndarray:
        """Twice the integral of a law up to every `stride`-th column (and the last), in columns, `[rows, steps]`."""
        whole = (law[:, :-1].astype(np.int64) + law[:, 1:]).cumsum(1)
        last = whole.shape[1]
        ends = [min(k + stride, last) - 1 for k in range(0, last, stride)]
        return whole[:, ends]


@torch.no_grad()
def make_tables(bsdf: DualScattering, proposal: AmortisedProposal) -> Tables:
    """The tables of a BSDF and its proposal.

    Columns of |phi| are those of the proposal's laws, filled up to a multiple of 4; N^G, which is smooth, has every
    other column. Rows of |theta_diff| are twice as close as those of the laws.

    Raises:
        InputError: what `check_exported` refuses.
    """
    check_exported(bsdf, proposal)
    fiber, own = bsdf.fiber.to(torch.float64), bsdf
    laws = law_tables(proposal)
    rows = (laws.grid.rows - 1) * _FINER + 1
    cells = -(-(laws.grid.columns - 1) // 4) * 4
    diff = torch.linspace(0.0, HALF_PI, rows, dtype=torch.float64)[:, None]
    around = torch.linspace(0.0, math.pi, cells + 1, dtype=torch.float64)[None]
    quarter = torch.linspace(0.0, HALF_PI, cells // 4 + 1, dtype=torch.float64)[None]
    spread = own.azimuthal_scattered(diff, quarter)
    spread = torch.cat([spread[..., 0, :1], spread[..., 1, :], spread[..., 2, :]], dim=-1)
    lobes, c_m = proposal.lobes, bsdf.convention.lobe_constant
    depths = int((lobes.depths <= _DEEPEST).sum())
    far = lobes.scattered[:, :depths].double()
    start, step, shape = _evenly(far[:, :, 1:])
    network = proposal.network
    return Tables(
        eta=float(fiber.eta),
        lobe_constant=c_m,
        back_factor=2 * float(bsdf.d_b) / math.pi,
        log_density=bsdf.convention.density_power * math.log(max(float(bsdf.d_f), 1e-38)),
        scattered_back=math.pi if bsdf.convention.back_factor == "pi" else 1.0,
        alpha=_floats(fiber.alpha),
        variance=_floats(fiber.beta**2),
        sigma_a=_floats(fiber.sigma_a),
        half_back=bsdf.convention.back_azimuth == "back",
        poisson=bsdf.convention.transmittance == "poisson",
        trt=_by_row(own.azimuthal(diff, around)[..., 2, :]),
        spread=_by_middle(spread),
        averages=_rounded(average_table(own)),
        laws=tuple(_law(x, cells // (1 if k < 3 else 2)) for k, x in enumerate(laws.density)),
        components=tuple(_law_of(proposal, k, laws.number) for k in range(len(proposal.names))),
        near=_floats(lobes.direct.round(decimals=5)),
        far_energy=_floats(far[:, :, 0].round(decimals=3)),
        far_shape=shape,
        shape_start=start,
        shape_step=step,
        depths=_floats(lobes.depths[:depths]),
        layers=tuple((_floats(b), _floats(w.t())) for w, b in zip(network.weights, network.biases, strict=True)),
        log_lobes=math.log1p(-proposal.defensive),
        sphere=proposal.defensive / (4 * math.pi),
    )


def _floats(x: Tensor) -> np.ndarray:
    return x.detach().to(torch.float32).contiguous().numpy()


def _rounded(x: Tensor) -> np.ndarray:
    """Float32 numbers of few digits."""
    flat = [float(f"{value:.{_DIGITS}g}") for value in x.flatten().tolist()]
    return np.array(flat, dtype=np.float32).reshape(x.shape)


def _by_row(table: Tensor) -> Rows:
    """Each row and channel `[rows, columns, k]` relative to its largest number."""
    scale = (table.amax(1) / _TOP).numpy().astype(np.float32)
    return _divided(table, np.where(scale < _SMALLEST, 0, scale))


def _by_middle(table: Tensor) -> Rows:
    """Each row and channel in units that make the last column 32767, so that twice of it minus any fits 16 bits."""
    scale = (table[:, -1] / (_TOP // 2)).numpy().astype(np.float32)
    found = _divided(table, np.where(scale < _SMALLEST, 0, scale))
    return Rows(np.minimum(found.values, 2 * found.values[:, -1:]), found.scale)


def _divided(table: Tensor, scale: np.ndarray) -> Rows:
    unit = np.where(scale > 0, scale, np.inf).astype(np.float64)[:, None]
    return Rows(np.rint(table.numpy() / unit).clip(0, _TOP).astype(np.uint16), scale)


def _law(density: Tensor, cells: int) -> np.ndarray:
    """A law of |phi| on `cells` columns, 16-bit; linear between the nodes that were there."""
    columns = density.shape[1] - 1
    if columns % cells == 0:
        nodes = density[:, :: columns // cells]
    else:
        nodes = torch.nn.functional.interpolate(density[None], size=cells + 1, mode="linear", align_corners=True)[0]
    value = np.rint((nodes / nodes.amax(1, keepdim=True) * _TOP).numpy()).astype(np.uint16)
    return value


def _law_of(proposal: AmortisedProposal, k: int, number: dict[int, int]) -> int:
    law = proposal.laws[k]
    if isinstance(law, FiberAzimuth):
        return number[k]
    return BACK if isinstance(law, BackHalf) else ALL


def _evenly(shape: Tensor) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Start and step of each of the three kinds of numbers in `[rows, depths, 3, lobes]`, and how many steps."""
    low, high = shape.amin((0, 1, 3)), shape.amax((0, 1, 3))
    start, step = _floats(low), _floats((high - low) / torch.tensor(_STEPS))
    if not (step > 0).all():
        raise InputError("proposal.lobes", shape[0, 0].tolist(), "moments that differ between contexts")
    steps = (shape.numpy() - start.astype(np.float64)[:, None]) / step.astype(np.float64)[:, None]
    return start, step, np.rint(steps).clip(0, _TOP).astype(np.uint16)
