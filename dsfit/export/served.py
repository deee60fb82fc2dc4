"""What a header can hold, and what it cannot."""

from __future__ import annotations

import torch

from dsfit.bsdf.dual_scattering import DualScattering
from dsfit.bsdf.terms import Terms
from dsfit.errors import InputError
from dsfit.kernels.moments import is_served
from dsfit.kernels.tables import check_served
from dsfit.proposals.amortised import AmortisedProposal, fiber_numbers


def check_bsdf(bsdf: DualScattering) -> None:
    """Raise `InputError` for what a header does not hold: eccentric fibres and batches of them, azimuths other than
    `marschner`, switches of the convention that change the shape of the formula, terms that are left out."""
    if not isinstance(bsdf, DualScattering):
        raise InputError("bsdf", type(bsdf).__name__, "a dsfit DualScattering")
    check_served(bsdf)
    if bsdf.terms != Terms():
        raise InputError("bsdf.terms", bsdf.terms, "all terms: a header computes the whole BSDF")


def check_exported(bsdf: DualScattering, proposal: AmortisedProposal) -> None:
    """Raise `InputError` for a BSDF that `check_bsdf` refuses, a proposal other than an `AmortisedProposal`, and one of
    another fibre."""
    check_bsdf(bsdf)
    if not isinstance(proposal, AmortisedProposal) or not is_served(proposal):
        raise InputError("proposal", type(proposal).__name__, "a dsfit AmortisedProposal")
    own, given = fiber_numbers(bsdf), proposal.fiber.double()
    if not torch.equal(given, own):
        raise InputError("proposal", f"of fibre {given.tolist()}", f"a proposal of the BSDF's fibre, {own.tolist()}")
