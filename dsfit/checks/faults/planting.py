"""Planting a fault: a function of the library is replaced wherever it has been imported, and put back afterwards."""

from __future__ import annotations

import contextlib
import functools
import importlib
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

from dsfit.checks.finding import Finding


@dataclass(frozen=True)
class Patch:
    """What is replaced, "package.module:function" or "package.module:Class.method", and by what, given the original."""

    target: str
    make: Callable[[Any], Any]


@dataclass(frozen=True)
class Fault:
    """A slip that somebody could make.

    Attributes:
        name: as in `dsfit check --set check.faults.faults=[name]`.
        module: where it is planted.
        slip: what is wrong, in words.
        patches: how.
        suite: the check that has to catch it.
        look: runs that check, small, on something that the fault touches: seed to findings.
        caught: False for a slip that no check sees, as nothing that a check could measure is wrong.
    """

    name: str
    module: str
    slip: str
    patches: Sequence[Patch]
    suite: str
    look: Callable[[int], list[Finding]]
    caught: bool = True


@contextlib.contextmanager
def planted(patches: Sequence[Patch]) -> Iterator[None]:
    """The library with these faults in it."""
    undo: list[tuple[Any, str, Any]] = []
    try:
        for patch in patches:
            module_name, _, path = patch.target.partition(":")
            owner: Any = importlib.import_module(module_name)
            *outer, name = path.split(".")
            for part in outer:
                owner = getattr(owner, part)
            original = vars(owner)[name]
            wrapper = type(original) if isinstance(original, staticmethod | classmethod) else None
            wrong = patch.make(original.__func__) if wrapper else patch.make(original)
            wrong = wrapper(wrong) if wrapper else wrong
            holders = [(owner, name)] if outer else list(_holders(original))
            for holder, attribute in holders:
                undo.append((holder, attribute, original))
                setattr(holder, attribute, wrong)
        yield
    finally:
        for holder, attribute, original in reversed(undo):
            setattr(holder, attribute, original)


def _holders(original: Any) -> Iterator[tuple[Any, str]]:
    """Every module of the library that knows this object, under whatever name."""
    for module_name, module in list(sys.modules.items()):
        if module_name.partition(".")[0] == "dsfit" and module is not None:
            for attribute, value in list(vars(module).items()):
                if value is original:
                    yield module, attribute


def scaled(factor: float) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """A function whose result is off by a factor."""
    return changed(lambda result, *_: result * factor)


def changed(change: Callable[..., Any]) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """A function whose result is changed: `change(result, *args)`."""

    def make(original: Callable[..., Any]) -> Callable[..., Any]:
        @functools.wraps(original)
        def wrong(*args: Any, **kwargs: Any) -> Any:
            return change(original(*args, **kwargs), *args)

        return wrong

    return make
