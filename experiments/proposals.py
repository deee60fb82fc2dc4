"""Every proposal of the chapter as printed and as the library has it, and the library's own: densities and samples."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import torch
from pydantic import Field

from dsfit.bsdf.dual_scattering import DualScattering
from dsfit.bsdf.fiber import Fiber
from dsfit.context import Context
from dsfit.figures import Close, Data, Estimate, Experiment, Settings, Work
from dsfit.proposals.base import Proposal
from dsfit.proposals.chapter import chapter_proposals
from dsfit.proposals.printed import CosineAsPrinted
from experiments import _proposals_maps as maps
from experiments._proposals_laws import DEG, Law, laws
from experiments._proposals_measure import (
    EVERY,
    count_error,
    distance,
    distance_error,
    draw,
    kept,
    marginal,
    point_share,
    quantiles,
)
from experiments._proposals_own import components, measure_own, own_proposals

FORMS = ("printed", "corrected")
WRONG = "cosine_as_printed"
"""The one map of a sampler that is wrong: what that looks like."""


class Proposals(Settings):
    """Fibre, contexts, and numbers of samples; see `configs/figures/proposals.toml`."""

    preset: str = "blond"
    theta_r_deg: float = Field(45.0, gt=-90, lt=90)
    grazing_deg: float = Field(80.0, gt=-90, lt=90)
    n: float = Field(3.0, ge=0)
    v: float = Field(0.5, ge=0, le=1)
    samples: int = Field(20_000, ge=1000)
    map_samples: int = Field(100_000, ge=1000)
    bins: int = Field(48, ge=8)
    fit_steps: int = Field(100, ge=1)
    seed: int = 1


def compute(settings: Proposals, work: Work) -> Data:
    """Marginals, quantiles and histograms of every law in both forms; own mixtures; maps over (theta_i, phi)."""
    bsdf = DualScattering(Fiber.preset(settings.preset), precision="table")
    context = Context(settings.theta_r_deg * DEG, 0.0, settings.n, settings.v, dtype=torch.float64)
    chapter = laws(bsdf, settings.theta_r_deg, settings.grazing_deg, settings.n)
    arrays = measure_laws(chapter, settings, work.say)
    own = own_proposals(bsdf, context, settings.fit_steps)
    seed = 1_000_003 * settings.seed
    shown, found = measure_own(bsdf, own, context, settings.samples, settings.bins, seed + 1, work.say)
    arrays |= shown | {"own.distance": found, "own.distance_error": distance_error(found, settings.samples)}
    over_both = {**chapter_proposals(bsdf), **own, WRONG: CosineAsPrinted()}
    cells = measure_maps(over_both, context, settings.map_samples, seed + 2, work.say)
    record = {
        "preset": settings.preset,
        "context": [settings.theta_r_deg, settings.n, settings.v],
        "samples": settings.samples,
        "map_samples": settings.map_samples,
        "laws": [described(law) for law in chapter],
        "own": [{"name": name, "parts": components(proposal)} for name, proposal in own.items()],
        "maps": list(over_both),
    }
    return Data(arrays | cells, record)


def measure_laws(chapter: Sequence[Law], settings: Proposals, say: Callable[[str], None]) -> dict[str, np.ndarray]:
    """Arrays `NAME.FORM.*` of every law, `mass` and `points` (share in one value) `[L, 2]`, `distance` `[L, 3]`.

    Distances are those of the printed sampler from the printed density and from the corrected one, and of the
    corrected sampler from the corrected density, each brought to mass 1.
    """
    arrays: dict[str, np.ndarray] = {}
    masses, distances, points = [], [], []
    for k, law in enumerate(chapter):
        say(f"{law.name}: eq {law.equations}")
        claimed, drawn = [], []
        for j, (form, proposal) in enumerate(zip(FORMS, (law.printed, law.corrected), strict=True)):
            distribution = proposal(law.context)
            claimed.append(marginal(distribution, law.context, law.axis))
            seed = 1_000_003 * settings.seed + 7919 * (2 * k + j)
            drawn.append(draw(distribution, law.context, law.axis, settings.samples, seed))
            shown = quantiles(distribution, law.context, law.axis)
            arrays |= kept(f"{law.name}.{form}", claimed[-1], shown, drawn[-1], law.axis, settings.bins)
        x = claimed[0].x[::EVERY]
        if law.printed_cdf is not None:
            arrays[f"{law.name}.printed.cdf"] = law.printed_cdf(torch.as_tensor(x)).numpy().astype(np.float32)
        if law.target is not None:
            value = law.target(torch.as_tensor(x)).numpy()
            arrays[f"{law.name}.target"] = (value / np.trapezoid(value, x)).astype(np.float32)
        masses.append([one.mass for one in claimed])
        points.append([point_share(form(law.context), law.context, law.axis) for form in (law.printed, law.corrected)])
        pairs = ((drawn[0], claimed[0]), (drawn[0], claimed[1]), (drawn[1], claimed[1]))
        distances.append([distance(sample, one) for sample, one in pairs])
    found = np.array(distances)
    errors = distance_error(found, settings.samples)
    return arrays | {"mass": np.array(masses), "points": np.array(points), "distance": found, "distance_error": errors}


def described(law: Law) -> dict[str, Any]:
    """What the drawing has to know of a law besides its arrays."""
    return {
        **{key: getattr(law, key) for key in ("name", "page", "equations", "title", "slip", "axis")},
        "theta_r_deg": round(math.degrees(float(law.context.theta_r)), 6),
        "has_printed_cdf": law.printed_cdf is not None,
    }


def measure_maps(
    proposals: Mapping[str, Proposal], context: Context, samples: int, seed: int, say: Callable[[str], None]
) -> dict[str, np.ndarray]:
    """Arrays `map.NAME.expected`, `.observed`, `.observed_error`, and `map.mass` `[M]`."""
    arrays: dict[str, np.ndarray] = {}
    masses = []
    for k, (name, proposal) in enumerate(proposals.items()):
        say(f"map of {name}")
        found = maps.measure(proposal, context, samples, seed + 7919 * k)
        arrays[f"map.{name}.expected"] = found.expected.astype(np.float32)
        arrays[f"map.{name}.observed"] = found.observed.astype(np.int32)
        arrays[f"map.{name}.observed_error"] = count_error(found.observed).astype(np.float16)
        masses.append(found.mass)
    return arrays | {"map.mass": np.array(masses)}


_ANY = math.inf  # counts of 0 and distances of samples from their own law are as they should be

EXPERIMENT = Experiment(
    title="Proposals: densities, distribution functions, inverses and samples, as printed and as corrected",
    shows="Every law of the chapter in its printed form beside the library's, the library's own mixtures with their "
    "components, and maps of all proposals over (θ_i, φ) with samples and residuals.",
    settings=Proposals,
    compute=compute,
    minutes=0.6,
    reproduces={
        "own.distance": Estimate("own.distance_error", most=_ANY),
        "distance": Estimate("distance_error", most=_ANY),
        "*.counts": Estimate("*.counts_error", most=_ANY),
        "map.*.observed": Estimate("map.*.observed_error", most=_ANY),
        # where a fit stops depends on rounding; its density does so less
        **{f"own.fitted.*.{name}": Close(1e-3, 1e-3) for name in ("density", "cdf", "quantiles", "parts")},
        "map.fitted.expected": Close(1e-3, 1.0),
        "map.*.expected": Close(1e-4, 1e-3),
        "mass": Close(1e-6),
        "map.mass": Close(1e-5),
        "points": Close(1e-4),
        "own.target*": Close(1e-5, 1e-6),
        **{f"*.{name}": Close(1e-5, 1e-5) for name in ("density", "cdf", "quantiles", "parts", "target")},
    },
    small=("samples=2000", "map_samples=2000", "fit_steps=2"),
)
