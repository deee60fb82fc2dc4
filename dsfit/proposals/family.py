"""One proposal for a family of fibres: a network that is told the fibre besides the shading context."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from dsfit.bsdf.dual_scattering import DualScattering
from dsfit.context import Context
from dsfit.errors import InputError, as_number
from dsfit.proposals.amortised import _FEATURES as CONTEXT_FEATURES
from dsfit.proposals.amortised import AmortisedProposal
from dsfit.proposals.base import Proposal
from dsfit.proposals.fiber_family import FiberFamily
from dsfit.proposals.lobe_moments import DIRECT, SCATTERED
from dsfit.proposals.mixture import MixtureDistribution
from dsfit.proposals.network import Network, soft
from dsfit.proposals.quick_moments import QuickMoments
from dsfit.proposals.quick_tables import QuickScattering
from dsfit.proposals.uniform import BackHalf, UniformAzimuth, UniformSphere

NAMES = (*DIRECT, *SCATTERED, "back", "broad")
_WHOLE = len(NAMES)
_FIBER_FEATURES, _LOBE_FEATURES = 11, 4
FEATURES = CONTEXT_FEATURES + _FIBER_FEATURES + _LOBE_FEATURES * (_WHOLE - 1)
_TYPICAL_WIDTHS = (7.5, 3.75, 15.0)


class FamilyMember(AmortisedProposal):
    """The proposal of one fibre of a family, for every context (theta_r, n, v); made by `FamilyProposal.of`.

    An `AmortisedProposal` whose tables are made quickly (`QuickScattering`, `QuickMoments`) and whose network is the
    family's: besides the context it sees the fibre (widths, shift, section, colours, transmittance) and the lobes that
    the tables give at the context (weights, means, widths, skews). Untrained, the correction is zero.

    Args:
        bsdf: the fibre's BSDF.
        network: from features `[*batch, FEATURES]` to corrections `[*batch, 4 K]`; shared, not copied.
        defensive: share of the uniform sphere.
    """

    about: Tensor

    def __init__(self, bsdf: DualScattering, network: nn.Module, defensive: float) -> None:
        nn.Module.__init__(self)
        quick = bsdf if isinstance(bsdf, QuickScattering) else QuickScattering(bsdf)
        self.defensive, self.names = defensive, NAMES
        self.lobes = QuickMoments(quick)
        self.register_buffer("about", _about_fiber(quick))
        direct, scattered = quick.azimuth_laws(False), quick.azimuth_laws(True)
        back = BackHalf() if quick.convention.back_azimuth == "back" else UniformAzimuth()
        self.laws = nn.ModuleList([*direct, *scattered, scattered[0], scattered[0], back, UniformAzimuth()])
        self.sphere, self.network = UniformSphere(), network

    def start(self, context: Context) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        """As `AmortisedProposal.start`, with the features of fibre and lobes appended."""
        mean, below, above, energy, features = super().start(context)
        fiber = self.about.to(features).expand(*features.shape[:-1], -1)
        seen = torch.cat([features, fiber, _lobe_features(mean, below, above, energy)], dim=-1)
        return mean, below, above, energy, seen


class FamilyProposal(Proposal):
    """One proposal for all fibres of a family: `family.of(bsdf)` is the proposal of one of them, without training.

    What concerns one lobe of one fibre is tabulated (azimuths given theta_diff, energies, means and widths at every
    inclination and depth; some 0.4 s for a round section, 1 s else); how the lobes of a mixture best share the
    integrand is the network's, trained once for the family by `dsfit.fit.amortise.family.train_family`.

    Args:
        family: ranges of the fibres.
        hidden: sizes of the network's hidden layers.
        defensive: share of the uniform sphere, in (0, 1).
        seed: of the network's first weights.

    Raises:
        InputError: an argument out of range.

    Example:
        >>> import dsfit
        >>> bsdf = dsfit.DualScattering(dsfit.Fiber.preset("brown"), precision="table")
        >>> proposal = dsfit.FamilyProposal().of(bsdf)  # in half a second, here of the untrained family
        >>> context = dsfit.Context(0.2, n=0.0)
        >>> float(dsfit.excess(dsfit.Integrand(bsdf), proposal, context, 1e-2).value) < 0.05
        True
    """

    def __init__(
        self,
        family: FiberFamily | None = None,
        hidden: tuple[int, ...] = (48, 48),
        defensive: float = 0.001,
        *,
        seed: int = 0,
    ) -> None:
        super().__init__()
        if family is not None and not isinstance(family, FiberFamily):
            raise InputError("family", type(family).__name__, "a FiberFamily")
        self.family = FiberFamily() if family is None else family
        self.defensive = as_number("defensive", defensive, 0.0, 1.0, open_low=True, open_high=True)
        self.network = Network((FEATURES, *hidden, 4 * _WHOLE), torch.Generator().manual_seed(seed))

    def of(self, bsdf: DualScattering, *, extrapolate: bool = False) -> FamilyMember:
        """The proposal of one fibre.

        Args:
            bsdf: a single fibre; its `precision` does not matter.
            extrapolate: also for fibres outside the family, which the network was not trained for. Such a proposal is
                still normalised, and estimates with it unbiased.

        Raises:
            InputError: a batch of fibres, a density of zero, or (unless `extrapolate`) a fibre outside the family.
        """
        if not isinstance(bsdf, DualScattering):
            raise InputError("bsdf", type(bsdf).__name__, "a DualScattering")
        if bsdf.fiber.batch_shape:
            raise InputError("bsdf.fiber", tuple(bsdf.fiber.batch_shape), "a single fibre")
        if not (bool(bsdf.d_b > 0) and bool(bsdf.d_f > 0)):
            raise InputError("bsdf.d_f, d_b", (float(bsdf.d_f), float(bsdf.d_b)), "positive densities")
        for name, (value, allowed) in self.family.outside(bsdf).items():
            if not extrapolate:
                raise InputError(f"bsdf.{name}", value, f"{allowed} in this family (or extrapolate=True)")
        return FamilyMember(bsdf, self.network, self.defensive)

    def forward(self, context: Context) -> MixtureDistribution:
        """A family is no distribution before it is told a fibre.

        Raises:
            InputError: always.
        """
        raise InputError("proposal", "FamilyProposal", "the proposal of one fibre: family.of(bsdf)")


def _about_fiber(bsdf: QuickScattering) -> Tensor:
    """Widths, shift and section; colours of TT, TRT and back scattering at normal incidence; and how much light the
    fibre passes on there and at 60 degrees; `[11]`."""
    fiber, zero = bsdf.fiber, torch.zeros((), dtype=torch.float64)
    degrees = fiber.beta.detach().to(torch.float64) * (180 / math.pi)
    widths = torch.log(degrees / torch.tensor(_TYPICAL_WIDTHS, dtype=torch.float64))
    shift = fiber.alpha.detach().to(torch.float64)[0] * (180 / math.pi) / 7.5 + 1
    flat = 10 * (1 - fiber.eccentricity.detach().to(torch.float64))
    average = bsdf.averages(torch.tensor([0.0, math.pi / 3], dtype=torch.float64))
    rows = [bsdf._mean_shares.energies(p, zero) for p in (1, 2)]
    colours = [x.amin(-1) / x.amax(-1).clamp_min(1e-30) for x in (*rows, average.A_b[0])]
    passed = [average.a_f.amax(-1), average.a_f.amin(-1)[:1]]
    return torch.cat([widths, torch.stack([shift, flat, *colours]), *passed])


def _lobe_features(mean: Tensor, below: Tensor, above: Tensor, energy: Tensor) -> Tensor:
    """Square roots of the weights, means, widths and skews of the tabulated lobes, `[*batch, 4 (K - 1)]`."""
    used = slice(0, _WHOLE - 1)
    weight = torch.softmax(energy[..., used], dim=-1)
    root = torch.sqrt(weight + 1e-12)  # whose slope stays finite where a lobe is out
    width = soft((below + above)[..., used] / 2 - math.log(0.2))
    return torch.cat([root, mean[..., used], width, soft((above - below)[..., used])], dim=-1)


__all__ = ["FEATURES", "NAMES", "FamilyMember", "FamilyProposal"]
