"""Ou et al. (2012): lobes in proportion to their energy, Cauchy laws, analytic azimuths."""

from __future__ import annotations

from typing import ClassVar

from dsfit.context import Context
from dsfit.errors import as_number
from dsfit.proposals.ou import OuProposal
from dsfit.proposals.ou_azimuth import SCALE
from dsfit.race.density import DensitySampler
from dsfit.race.peer import Peer, Problem, Sampler


class OuCauchy(Peer):
    """`OuProposal` as a mixture: one sample, weighted by the density of all lobes (balance), has less variance than a
    fixed number of samples per lobe, for shares are in proportion to energies already.

    Args:
        scale: Cauchy scale over Gaussian standard deviation.
        glint_share: share of the glints in TRT.
    """

    name: ClassVar[str] = "ou_cauchy"

    def __init__(self, scale: float = SCALE, glint_share: float = 0.6) -> None:
        self.scale = as_number("ou_cauchy.scale", scale, 0.1, 10.0)
        ends = {"open_low": True, "open_high": True}
        self.glint_share = as_number("ou_cauchy.glint_share", glint_share, 0.0, 1.0, **ends)

    def prepare(self, problem: Problem) -> None:
        """Energies of the lobes over theta_r."""
        self.problem = problem
        self.proposal = OuProposal(problem.model.bsdf, self.scale, self.glint_share)

    def at(self, contexts: Context) -> Sampler:
        """Shares and widths at every context, in closed form."""
        return DensitySampler(self.problem, self.proposal(contexts), contexts)
