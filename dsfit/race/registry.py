"""The peers of a race by name: one line each."""

from __future__ import annotations

import functools
import importlib
import importlib.util
import inspect
from dataclasses import dataclass
from typing import Any

from dsfit.errors import InputError
from dsfit.race.peer import Peer


@dataclass(frozen=True)
class Entry:
    """Where a peer is (a module of `dsfit.race.peers`) and what it is, in a few words."""

    module: str
    about: str


PEERS = {
    "uniform": Entry("uniform", "uniform directions on the sphere"),
    "single": Entry("chapter", "one proposal of the chapter, with a share of the uniform sphere if asked for"),
    "chapter": Entry("chapter", "the chapter's proposals in equal shares, by any MIS heuristic"),
    "best_mix": Entry("chapter_mix", "the chapter's proposals, shares and heuristic fitted to each context"),
    "stream_mix": Entry("chapter_mix", "the chapter's proposals, shares fitted once to the stream of contexts"),
    "structured": Entry("structured", "the structured family as it starts at each context"),
    "fitted": Entry("fitted", "the structured family fitted to each context"),
    "amortised": Entry("amortised", "one proposal trained once for all contexts of the fibre"),
    "kernel": Entry("kernel", "the amortised proposal drawn and evaluated by compiled kernels"),
    "ou_cauchy": Entry("cauchy", "Ou et al. 2012: Cauchy lobes and exponential caps"),
    "deon_offset": Entry("offset", "d'Eon et al. 2013: lobe, then offset through the fibre"),
    "table_2d": Entry("table", "a piecewise constant table of each context"),
    "table_grid": Entry("table", "tables of a grid of contexts, made once"),
    "vegas": Entry("vegas", "VEGAS+ adapted to each context"),
    "zuko_flow": Entry("flow", "a conditional normalising flow trained once"),
}


@functools.cache
def peer_class(kind: str) -> type[Peer]:
    """The class of a peer; its module is imported when first asked for.

    Raises:
        InputError: no peer of that name.
    """
    if kind not in PEERS:
        raise InputError("peer", kind, "one of " + ", ".join(PEERS))
    module = importlib.import_module(f"dsfit.race.peers.{PEERS[kind].module}")
    found = [
        value
        for _, value in inspect.getmembers(module, inspect.isclass)
        if issubclass(value, Peer) and getattr(value, "name", None) == kind
    ]
    if len(found) != 1:
        raise InputError("peer", kind, f"one class with that name in {module.__name__}")
    return found[0]


def make(kind: str, options: dict[str, Any] | None = None) -> Peer:
    """A new peer with these options.

    Raises:
        InputError: unknown peer or option, or an option out of range.
    """
    cls, options = peer_class(kind), dict(options or {})
    known = [name for name in inspect.signature(cls).parameters]
    for name in options:
        if name not in known:
            raise InputError(f"{kind}.{name}", options[name], "options " + ", ".join(known) if known else "no options")
    return cls(**options)


def missing(kind: str) -> list[str]:
    """Packages that the peer needs and that are not installed."""
    return [name for name in peer_class(kind).needs if importlib.util.find_spec(name) is None]
