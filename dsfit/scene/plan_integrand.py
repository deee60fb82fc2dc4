"""An integrand that computes what its plan kept, and refuses what the plan does not hold for."""

from __future__ import annotations

import torch
from torch import Tensor

from dsfit.bsdf.terms import Terms
from dsfit.context import Context
from dsfit.errors import InputError
from dsfit.scene.integrand import Integrand
from dsfit.scene.planning.boxes import Boxes, ContextRange
from dsfit.scene.scattering import ConstantScattering
from dsfit.special import is_differentiated, is_wrapped


class PlannedIntegrand(Integrand):
    """As `Integrand`, with the BSDF's terms those of a plan; `whole` is the integrand that was planned.

    Derivatives are those of what is kept. One in a share (v, or n where v follows from it) of which a whole half was
    left out would be lost, and is refused.

    Args:
        whole: the integrand as it was.
        terms: what is kept.
        contexts: what the plan was made for.
        bounded: whether anything was left out by a bound, so that derivatives in the fibre are refused too.

    Raises:
        InputError: (on evaluation) a context outside the plan's, or a derivative that the plan does not keep.
    """

    def __init__(self, whole: Integrand, terms: Terms, contexts: Boxes | ContextRange, bounded: bool) -> None:
        super().__init__(whole.bsdf.replace(terms=terms), whole.light, whole.scattering)
        self.whole, self.terms, self._contexts, self._bounded = whole, terms, contexts, bounded
        self._seen: Context | None = None
        self._fields = _fields_read(whole)

    def __call__(self, omega_i: Tensor, context: Context) -> Tensor:
        self.check(context)
        return super().__call__(omega_i, context)

    def check(self, context: Context) -> None:
        """Raise `InputError` unless the plan holds for these contexts; under `torch.func` transforms, which hide the
        numbers, only derivatives are looked at.
        """
        if context is self._seen:
            return
        self._check_derivatives(context)
        if any(is_wrapped(getattr(context, name)) for name in self._fields):
            return
        if isinstance(self._contexts, ContextRange):
            name = self._contexts.outside(context, self._fields)
            if name is not None:
                allowed = f"contexts that the plan was made for: {self._contexts.describe()}"
                raise InputError(f"context.{name}", getattr(context, name).detach().tolist(), allowed)
        else:
            held = self._contexts.holds(context, self._fields)
            if not bool(held.all()):
                at = int(torch.nonzero(~held)[0])
                values = {name: getattr(context, name).detach().reshape(-1)[at].item() for name in self._fields}
                allowed = f"one of the {len(self._contexts)} contexts that the plan was made for, or plan anew"
                raise InputError("context", values, allowed)
        self._seen = context

    def _check_derivatives(self, context: Context) -> None:
        if self._bounded and self.bsdf.fiber.requires_grad:
            allowed = "one without gradients, or a plan made with them"
            raise InputError("fiber", "one that gradients are asked of", allowed)
        for half in ("direct", "scattered"):
            if getattr(self.terms, half) or not getattr(self.whole.bsdf.terms, half):
                continue
            for name in self._fields:
                if name != "theta_r" and is_differentiated(getattr(context, name)):
                    allowed = f"one without derivatives (the plan left F_{half} out), or a plan made with them"
                    raise InputError(f"context.{name}", "a tensor that a derivative is asked of", allowed)


def _fields_read(integrand: Integrand) -> tuple[str, ...]:
    """The fields of a context that the integrand depends on, besides phi_r, which no bound depends on."""
    scattering = integrand.scattering
    if not isinstance(scattering, ConstantScattering):
        known = type(scattering).__module__.startswith("dsfit.")
        return ("theta_r",) if known else ("theta_r", "n", "v")
    if scattering.from_context:
        return ("theta_r", "n", "v")
    return ("theta_r", "n") if scattering.n is None else ("theta_r",)
