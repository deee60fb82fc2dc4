"""The techniques of a rendering by name: every peer of the race, some of them in a form for pictures, and a few more.
"""

from __future__ import annotations

import importlib
import inspect
from dataclasses import dataclass
from typing import Any

from dsfit.errors import InputError, as_number, check_choice
from dsfit.race.peer import Peer
from dsfit.race.registry import PEERS, peer_class
from dsfit.render.techniques.technique import Technique

_LIGHT_OPTIONS = {"light_heuristic": "rule", "light_model": "model"}


@dataclass(frozen=True)
class Entry:
    """Where a technique is (a module and its class; none: a peer of the race as it is), and what it is."""

    about: str
    module: str | None = None
    cls: str = ""


_OWN = {
    "light": Entry("directions by the light's radiance alone", "light", "LightAlone"),
    "best_mix": Entry("the chapter's proposals and light, shares fitted to the scene", "best_mix", "BestMix"),
    "guided": Entry("the amortised mixture, its lobes weighed by the light that comes through", "guided", "Guided"),
    "amortised": Entry("the amortised mixture with the grid's hints", "amortised", "Amortised"),
}
_LEFT_OUT = ("kernel",)  # evaluates a constant light and the context's own n: it would not estimate a picture

TECHNIQUES: dict[str, Entry] = {
    **{name: Entry(entry.about) for name, entry in PEERS.items() if name not in _LEFT_OUT},
    **_OWN,
}
"""Names and what they are."""


def technique_class(kind: str) -> type[Peer]:
    """The class of a technique; its module is imported when first asked for.

    Raises:
        InputError: no technique of that name.
    """
    entry = TECHNIQUES[check_choice("technique", kind, tuple(TECHNIQUES))]
    if entry.module is None:
        return peer_class(kind)
    return getattr(importlib.import_module(f"dsfit.render.techniques.{entry.module}"), entry.cls)


def technique(
    kind: str, options: dict[str, Any] | None = None, *, light: float = 0.0, uniforms: str = "random", seed: int = 1
) -> Technique:
    """A new technique.

    Args:
        kind: a name in `TECHNIQUES`.
        options: of its class; with `light` > 0 also `light_heuristic` (default "balance") and `light_model` ("multi" or
            "one"), which combine light sampling with techniques of one density. Sets of strategies keep their own rule,
            with light as one more strategy.
        light: share of the samples for light sampling, in [0, 1).
        uniforms: "random" or "sobol" (see `RenderProblem`).
        seed: of whatever is prepared.

    Raises:
        InputError: unknown kind or option, or an option out of range.
    """
    cls, options = technique_class(kind), dict(options or {})
    known = list(inspect.signature(cls).parameters)
    extra = [name for name in _LIGHT_OPTIONS if light and name not in known]
    for name in options:
        if name not in (*known, *extra):
            allowed = "options " + ", ".join([*known, *extra]) if known or extra else "no options"
            raise InputError(f"{kind}.{name}", options[name], allowed)
    combined = {_LIGHT_OPTIONS[name]: options.pop(name) for name in extra if name in options}
    share = as_number("light", light, 0.0, 1.0, open_high=True)
    peer = cls(**options)
    if share:
        from dsfit.render.techniques.light import WithLight

        peer = WithLight(peer, share, **combined)
    return Technique(kind, peer, uniforms=uniforms, seed=seed)
