"""d'Eon et al. (2013): a lobe by attenuation at a sampled offset, its azimuth by Snell's law."""

from __future__ import annotations

from typing import ClassVar

from dsfit.context import Context
from dsfit.errors import as_number
from dsfit.proposals.deon import DeonProposal
from dsfit.race.density import DensitySampler
from dsfit.race.peer import Peer, Problem, Sampler

_ENDS = {"open_low": True, "open_high": True}


class DeonOffset(Peer):
    """`DeonProposal` with the density of all lobes and offsets that lead to a direction.

    Args:
        glint_share: share of TRT's energy that covers the glints.
        defensive: share of the uniform sphere.
    """

    name: ClassVar[str] = "deon_offset"

    def __init__(self, glint_share: float = 0.8, defensive: float = 0.05) -> None:
        self.glint_share = as_number("deon_offset.glint_share", glint_share, 0.0, 1.0, **_ENDS)
        self.defensive = as_number("deon_offset.defensive", defensive, 0.0, 1.0, **_ENDS)

    def prepare(self, problem: Problem) -> None:
        """Energies of the lobes over theta_r."""
        self.problem = problem
        self.proposal = DeonProposal(problem.model.bsdf, self.glint_share, self.defensive)

    def at(self, contexts: Context) -> Sampler:
        """Shares and widths at every context, in closed form."""
        return DensitySampler(self.problem, self.proposal(contexts), contexts)
