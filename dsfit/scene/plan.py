"""What a given scene does not need, left out before anything is evaluated; with a proven bound on the error."""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import torch

from dsfit.bsdf.dual_scattering import DualScattering
from dsfit.bsdf.grey import is_grey
from dsfit.bsdf.terms import Terms
from dsfit.context import Context
from dsfit.errors import InputError, as_number
from dsfit.scene.integrand import Integrand
from dsfit.scene.plan_integrand import PlannedIntegrand
from dsfit.scene.planning.boxes import Boxes, ContextRange
from dsfit.scene.planning.choice import Choice, choose
from dsfit.scene.planning.exact import exact_reasons, fade_is_over, why_no_bound
from dsfit.scene.planning.surroundings import arrival, radiance
from dsfit.scene.planning.terms import NAMES, TREATMENTS, bound_terms

if TYPE_CHECKING:
    from dsfit.proposals.base import Proposal
    from dsfit.scene.plan_proposal import Pruned

Key = tuple[str, str]


@dataclass(frozen=True)
class Dropped:
    """Something that is not computed.

    Attributes:
        half, name: which term: "direct" or "scattered", and "R", "TT", "TRT", "back" or "glint" (the treatment of TRT's
            caustic).
        reason: why it may go.
        bound: proven bound on the error this makes in the integral, relative to the integral of what is kept: the
            largest over contexts and channels. 0 where nothing changes.
        peak: proven bound on the term itself in any direction, in units of the integrand (per steradian); inf where
            none is proven.
    """

    half: str
    name: str
    reason: str
    bound: float = 0.0
    peak: float = 0.0


@dataclass(frozen=True)
class Plan:
    """What is computed of an integrand, what is not, and why.

    Attributes:
        terms: what is kept, for `DualScattering(..., terms=...)` and kernels.
        dropped: everything that is left out.
        bound: proven bound on the error of all of it together, relative to the integral of what is kept, in every
            channel of every context; at most `tolerance`.
        tolerance: what was asked for.
        even: whether the integrand is even in azimuth, so that half the quadrature nodes do.
        contexts: what the plan holds for.
        limits: why nothing but exact zeros was left out, or None.
        whole: the integrand that was planned.
    """

    terms: Terms
    dropped: tuple[Dropped, ...]
    bound: float
    tolerance: float
    even: bool
    contexts: Boxes | ContextRange
    limits: str | None
    whole: Integrand

    @functools.cached_property
    def integrand(self) -> PlannedIntegrand:
        """What is kept, usable wherever an `Integrand` is."""
        return PlannedIntegrand(self.whole, self.terms, self.contexts, self.bound > 0)

    @property
    def kept(self) -> tuple[Key, ...]:
        """The terms of F that are computed."""
        return tuple((half, name) for half, name in NAMES if name in getattr(self.terms, half))

    @property
    def components(self) -> tuple[str, ...]:
        """Names of the lobes that a structured or amortised proposal needs."""
        lobes = [name if half == "direct" else f"{name}_scattered" for half, name in self.kept if name != "back"]
        return (*lobes, *(["back"] if any(name == "back" for _, name in self.kept) else []))

    def prune(self, proposal: Proposal, context: Context, **options: Any) -> Pruned:
        """A mixture without what does not pay for sampling what is kept; see `plan_proposal.prune`."""
        from dsfit.scene.plan_proposal import prune

        return prune(proposal, self.integrand, context, **options)

    def to_dict(self) -> dict[str, Any]:
        """Plain data, for result files."""
        return {
            "tolerance": self.tolerance,
            "bound": self.bound,
            "contexts": _describe(self.contexts),
            "kept": {half: list(getattr(self.terms, half)) for half in ("direct", "scattered")},
            "glint": self.terms.glint,
            "grey": self.terms.grey,
            "even": self.even,
            "limits": self.limits,
            "dropped": [
                {"half": d.half, "term": d.name, "reason": d.reason, "bound": d.bound, "peak": d.peak}
                for d in self.dropped
            ],
        }

    def __str__(self) -> str:
        from dsfit.scene.plan_table import table

        return table(self.to_dict())


def plan(integrand: Integrand, contexts: Context | ContextRange, tolerance: float = 0.0) -> Plan:
    """Leave out of an integrand whatever these contexts do not need.

    Exact, whatever the tolerance: a half of F whose share (v or 1 - v) is 0 in every context, back scattering where
    d_b = 0, scattered light where d_f = 0, the treatment of TRT's caustic where eta' >= 2 + Delta eta' or no TRT is
    left, all channels but one of a grey fibre. Within the tolerance: any further terms, chosen among all 256 choices so
    that the time saved is largest and the sum of their bounds, in every channel and context, is at most `tolerance`
    times the lower bound on the integral of what is left. Both are upper and lower sums over cells (see
    `dsfit.scene.planning`), never the largest of samples.

    A share, d_b or fibre that a derivative is asked of is not left out where that derivative would be lost.

    Args:
        integrand: BSDF x light x scattering; if planned already, what it was planned from.
        contexts: all contexts that the plan shall hold for, or a `ContextRange` of them.
        tolerance: largest error of the integral, relative to the integral of what is kept, in [0, 1).

    Raises:
        InputError: an integrand that is none (or has a BSDF of another kind), no context, a tolerance out of range.

    Example:
        >>> import dsfit
        >>> integrand = dsfit.Integrand(dsfit.DualScattering(dsfit.Fiber.preset("blond"), d_b=0.0))
        >>> found = dsfit.plan(integrand, dsfit.Context(0.3, n=0.0))
        >>> found.bound, found.kept
        (0.0, (('direct', 'R'), ('direct', 'TT'), ('direct', 'TRT')))
    """
    whole = integrand.whole if isinstance(integrand, PlannedIntegrand) else integrand
    if not isinstance(whole, Integrand) or type(whole.bsdf) is not DualScattering:
        raise InputError("integrand", type(integrand).__name__, "an Integrand of a DualScattering")
    tolerance = as_number("tolerance", tolerance, 0.0, 1.0, open_high=True)
    if isinstance(contexts, Context) and contexts.batch_shape.numel():
        held: Boxes | ContextRange = Boxes.around(contexts)
    elif isinstance(contexts, ContextRange):
        held = contexts
    else:
        raise InputError("contexts", contexts, "a Context with at least one element, or a ContextRange")
    boxes = held.boxes() if isinstance(held, ContextRange) else held
    with torch.no_grad():
        reasons = exact_reasons(whole, boxes, contexts)
        limits = why_no_bound(whole)
        if tolerance == 0 or limits is not None:
            dropped, keep, treated = _exact_only(reasons)
            total = 0.0
        else:
            dropped, choice = _within(whole, boxes, reasons, tolerance)
            keep, treated, total = choice.keep, choice.treated, choice.total
    kept = [key for key, flag in zip(NAMES, keep, strict=True) if flag]
    trt = any(name == "TRT" for _, name in kept)
    treatable = whole.bsdf.model == "marschner" and whole.bsdf.terms.glint
    if treatable and treated and (not trt or fade_is_over(whole.bsdf)):
        treated = False
        reason = "eta' >= 2 + its fade everywhere" if trt else "no TRT is left"
        dropped.append(Dropped("both", "glint", reason))
    terms = Terms(
        direct=tuple(name for half, name in kept if half == "direct"),
        scattered=tuple(name for half, name in kept if half == "scattered"),
        glint=treated and whole.bsdf.terms.glint,
        grey=whole.bsdf.terms.grey or (whole.bsdf.channels > 1 and is_grey(whole.bsdf.fiber)),
    )
    limits = limits if tolerance > 0 else None
    return Plan(terms, tuple(dropped), total, tolerance, whole.is_even, held, limits, whole)


def _exact_only(reasons: dict[Key, str]) -> tuple[list[Dropped], tuple[bool, ...], bool]:
    return [Dropped(*key, reason) for key, reason in reasons.items()], tuple(key not in reasons for key in NAMES), True


def _within(whole: Integrand, boxes: Boxes, reasons: dict[Key, str], tolerance: float) -> tuple[list[Dropped], Choice]:
    """Exact drops and the best others, with their bounds."""
    bsdf, light = whole.bsdf, radiance(whole.light)
    assert light is not None
    bounds = bound_terms(bsdf, boxes, arrival(whole.scattering))
    exact = torch.tensor([key in reasons for key in NAMES])
    # Where light is strong in few directions, its whole power times the largest value of the term is the better bound.
    upper = torch.minimum(bounds.upper * light.high, _product(bounds.peak, light.total))
    upper = torch.where(torch.cat([exact, exact[[2, 6]]])[:, None], 0.0, upper)
    kept = bounds.kept * light.low
    table = bsdf.precision == "table"
    if table:
        upper[:, 9] = 0.0  # a table of N^G stays as it is
    treatment = bsdf.model == "marschner" and bsdf.terms.glint
    choice = choose(upper, kept, exact, tolerance, table=table, treatment=treatment)
    dropped = [Dropped(*key, reason) for key, reason in reasons.items()]
    peak = (bounds.peak * light.high).amax(-1)
    for k, (half, name) in enumerate((*NAMES, *TREATMENTS)):
        gone = not choice.keep[k] if k < 8 else not choice.treated and choice.keep[(2, 6)[k - 8]]
        if not gone or (half, name) in reasons or (k == 9 and table):
            continue
        where = _context(boxes, int(choice.worst[k]))
        bound = float(choice.bounds[k])
        reason = f"at most {bound:.1e} of what is kept" + (f" (at {where})" if len(boxes) > 1 else "")
        dropped.append(Dropped(half, name, reason, bound, float(peak[:, k].max())))
    return dropped, choice


def _product(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
    return torch.where((a == 0) | (b == 0), 0.0, a * b)


def _context(boxes: Boxes, index: int) -> str:
    theta, n, v = (float((x.low[index] + x.high[index]) / 2) for x in (boxes.theta_r, boxes.n, boxes.v))
    return f"theta_r {math.degrees(theta):.3g} deg, n {n:.3g}, v {v:.3g}"


def _describe(contexts: Boxes | ContextRange) -> str:
    if isinstance(contexts, ContextRange):
        return contexts.describe()
    return f"{len(contexts)} contexts" if len(contexts) > 1 else _context(contexts, 0)


__all__ = ["ContextRange", "Dropped", "Plan", "plan"]
