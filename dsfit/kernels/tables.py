"""What the kernels look up: azimuths over (theta_diff, |phi|), averages over theta_i, laws of azimuth, their CDFs."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from dsfit.bsdf.averages import Averages
from dsfit.bsdf.dual_scattering import DualScattering
from dsfit.errors import InputError
from dsfit.frame import HALF_PI
from dsfit.kernels.layout import GUIDE
from dsfit.proposals.amortised import AmortisedProposal
from dsfit.proposals.conditional import FiberAzimuth

AVERAGES = ("log a_f", "beta_f^2", "A_b", "Delta_b", "sigma_b^2")
_KNOTS = 1025
_TINY = 1e-30


@dataclass(frozen=True)
class Grid:
    """A uniform grid of |theta_diff| in [0, pi/2] and |phi| in [0, pi]: numbers of nodes."""

    rows: int
    columns: int

    def nodes(self) -> tuple[Tensor, Tensor]:
        """|theta_diff| and |phi| of the nodes, float64."""
        theta = torch.linspace(0.0, HALF_PI, self.rows, dtype=torch.float64)
        return theta, torch.linspace(0.0, math.pi, self.columns, dtype=torch.float64)


def check_served(bsdf: DualScattering) -> None:
    """Raise `InputError` for what the tables do not hold: batches of fibres, eccentric fibres, other azimuths than
    `marschner`, and switches that change the shape of the formula."""
    fiber, convention = bsdf.fiber, bsdf.convention
    if fiber.batch_shape:
        raise InputError("bsdf.fiber", tuple(fiber.batch_shape), "a single fibre")
    if not fiber.is_round:
        raise InputError("bsdf.fiber.eccentricity", float(fiber.eccentricity), "1: tables serve round fibres")
    if bsdf.model != "marschner":
        raise InputError("bsdf.azimuthal", bsdf.model, "'marschner'")
    needed = {
        "inverse_cos2": True,
        "share": "complement",
        "scattered_azimuth": "convolution",
        "back_argument": "theta_h",
        "back_width": "scatter",
        "average_angle": "theta_in",
        "absorption": "geometric",
    }
    for name, value in needed.items():
        if getattr(convention, name) != value:
            raise InputError(f"bsdf.convention.{name}", getattr(convention, name), repr(value))


def azimuth_columns(bsdf: DualScattering, grid: Grid) -> dict[str, Tensor]:
    """N_TRT `[rows, columns, C]`, N^G_R `[.., 1]`, N^G_TT and N^G_TRT `[.., C]` at the nodes, float64.

    N_R and N_TT have closed forms that cost less than a look-up.
    """
    theta, phi = grid.nodes()
    with torch.no_grad():
        direct = bsdf.azimuthal(theta[:, None], phi[None, :])
        scattered = bsdf.azimuthal_scattered(theta[:, None], phi[None, :])
    return {
        "TRT": direct[..., 2, :],
        "R_scattered": scattered[..., 0, :1],
        "TT_scattered": scattered[..., 1, :],
        "TRT_scattered": scattered[..., 2, :],
    }


def average_knots() -> Tensor:
    """Inclinations of the table of averages: closer and closer towards grazing, where the averages have layers.

    Uniform in y = sign(theta) (1 - sqrt(1 - 2 |theta| / pi)).
    """
    y = torch.linspace(-1.0, 1.0, _KNOTS, dtype=torch.float64)
    return torch.sign(y) * (1 - (1 - y.abs()) ** 2) * HALF_PI


def average_table(bsdf: DualScattering) -> Tensor:
    """`[knots, 5, C]` in the order of `AVERAGES`, float64."""
    theta = average_knots()
    inner = theta.clamp(-HALF_PI * (1 - 1e-9), HALF_PI * (1 - 1e-9))
    with torch.no_grad():
        average: Averages = bsdf.averages(inner)
    rows = [
        torch.log(average.a_f.clamp_min(_TINY)),
        average.beta_f**2,
        average.A_b,
        average.delta_b,
        average.sigma_b**2,
    ]
    return torch.stack(rows, dim=1)


@dataclass(frozen=True)
class LawTables:
    """Densities of |phi| on a common grid, `[laws, rows, columns]`, and their CDFs, float64; per row normalised.
    `number` says which of them each component of the proposal uses.
    """

    grid: Grid
    density: Tensor
    cumulative: Tensor
    number: dict[int, int]


def law_tables(proposal: AmortisedProposal) -> LawTables:
    """The azimuth laws of a proposal's components that are tables; components may share one."""
    laws: list[FiberAzimuth] = []
    number = {}
    for k, law in enumerate(proposal.laws):
        if not isinstance(law, FiberAzimuth):
            continue
        same = [i for i, known in enumerate(laws) if known is law]
        number[k] = same[0] if same else len(laws)
        if not same:
            laws.append(law)
    density = torch.stack([law.density.to(torch.float64) for law in laws])
    cumulative = torch.stack([law.cumulative.to(torch.float64) for law in laws])
    return LawTables(Grid(density.shape[1], density.shape[2]), density, cumulative, number)


def guides(cumulative: Tensor) -> Tensor:
    """`[..., GUIDE + 1]`, 16-bit: the last column whose CDF `[..., columns]` does not exceed k / GUIDE."""
    steps = (torch.arange(GUIDE + 1) / GUIDE).to(cumulative.dtype).expand(*cumulative.shape[:-1], -1).contiguous()
    last = cumulative.shape[-1] - 2
    return (torch.searchsorted(cumulative.contiguous(), steps, right=True) - 1).clamp(0, last).to(torch.int16)


def refined(values: Tensor, rows: int, columns: int) -> Tensor:
    """The bilinear function through `values [..., R, C]` at the nodes of a grid that contains theirs."""
    first = torch.nn.functional.interpolate(
        values.reshape(1, -1, *values.shape[-2:]), size=(rows, columns), mode="bilinear", align_corners=True
    )
    return first.reshape(*values.shape[:-2], rows, columns)
