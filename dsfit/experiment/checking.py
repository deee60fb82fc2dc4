"""From a config to the checks that it asks for: which suite is run over what, and by which proposals."""

from __future__ import annotations

import hashlib
import importlib.util
import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from dsfit.checks.suites import SUITES
from dsfit.errors import InputError
from dsfit.experiment import build
from dsfit.experiment.methods import chapter_names, single_proposals, structured_start
from dsfit.experiment.schema import Config

if TYPE_CHECKING:
    from dsfit.context import Context
    from dsfit.experiment.reader import RawConfig
    from dsfit.proposals.base import Proposal
    from dsfit.scene.integrand import Integrand

EXTRA_NAMES = ("light", "mixture", "structured", "fitted")
DEFENSIVE = 0.05  # share of the uniform sphere in "mixture"


def known_names() -> tuple[str, ...]:
    """Names that `check.proposals` may hold."""
    return (*chapter_names(), *EXTRA_NAMES)


def options_of(config: Config, suite: str) -> dict[str, Any]:
    """Keyword arguments of a suite from its table of the config."""
    return getattr(config.check, suite).model_dump()


def work_of(config: Config, first: bool) -> Iterator[dict[str, Any]]:
    """Identity of every cell of a grid point: suite, part and context; suites that need no scene belong to the first
    grid point alone."""
    for name in config.check.suites:
        suite = SUITES[name]
        if suite.scope == "context":
            for values in build.context_values(config.contexts):
                yield {"suite": name, "part": "", "context": values}
        elif suite.scope == "scene":
            yield {"suite": name, "part": "", "context": {}}
        elif first:
            for part in suite.load().parts(**options_of(config, name)):
                yield {"suite": name, "part": part, "context": {}}


def run_suite(
    config: Config, identity: dict[str, Any], label: str, say: Callable[[str], None]
) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """One cell: the suite's findings as plain data, and its arrays."""
    from dsfit.checks.subject import Subject

    # a seed of its own for every cell: equal random numbers would make their p-values dependent
    text = json.dumps([config.estimate.seed, identity], sort_keys=True)
    name, seed = identity["suite"], int.from_bytes(hashlib.sha256(text.encode()).digest()[:6])
    suite, options = SUITES[name], options_of(config, name)
    if suite.scope == "once":
        outcome = suite.load().run(identity["part"], seed=seed, say=say, **options)
    elif suite.scope == "scene":
        outcome = suite.load().run(build.integrand(config), seed=seed, say=say, **options)
    else:
        integrand, context = build.integrand(config), build.context(config, identity["context"])
        say("proposals")
        proposals = proposals_of(config, integrand, context)
        subject = Subject(integrand, context, proposals, label, seed)
        outcome = suite.load().run(subject, say=say, **options)
    return {"suite": name, "findings": [finding.to_dict() for finding in outcome.findings]}, outcome.arrays


def proposals_of(config: Config, integrand: Integrand, context: Context) -> dict[str, Proposal]:
    """The proposals that `[check]` names, at a single context, by name."""
    from dsfit.experiment.store import load_proposal
    from dsfit.proposals import Mixture

    names = config.check.proposals
    single = single_proposals(integrand)
    found: dict[str, Proposal] = {}
    for name in [n for n in known_names() if n != "fitted"] if names == "all" else names:
        if name in single:
            found[name] = single[name]
        elif name == "mixture":
            found[name] = Mixture([single[n] for n in chapter_names()], defensive=DEFENSIVE)
        else:
            found[name] = structured_start(integrand, context)
            if name == "fitted":
                from dsfit.fit.fit import fit

                found[name] = fit(found[name], integrand, context, seed=config.estimate.seed).proposal
    for path in config.check.saved:
        found[Path(path).name] = load_proposal(path)
    for reference in config.check.user:
        found[reference.rpartition("/")[2]] = user_function(reference)(integrand, context)
    return {name: proposal.requires_grad_(True) for name, proposal in found.items()}


def user_function(reference: str) -> Callable[..., Any]:
    """The function that `file.py:name` names; the file is run.

    Raises:
        InputError: there is no such file or function.
    """
    allowed = "'file.py:function', a function (integrand, context) -> Proposal"
    path, colon, name = reference.rpartition(":")
    if not colon or not path.endswith(".py") or not Path(path).is_file():
        raise InputError("check.user", reference, allowed)
    spec = importlib.util.spec_from_file_location(f"dsfit_user_{hashlib.sha256(path.encode()).hexdigest()[:8]}", path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    function = getattr(module, name, None)
    if not callable(function):
        raise InputError("check.user", reference, allowed)
    return function


def files_of(config: Config) -> list[str]:
    """Files whose content decides the result."""
    return [*config.check.saved, *(reference.rpartition(":")[0] for reference in config.check.user)]


def validate(raw: RawConfig, config: Config) -> None:
    """Refuse names that only the library knows, and files that cannot be read.

    Raises:
        ConfigError: naming the key.
    """
    from dsfit.experiment.reader import did_you_mean
    from dsfit.experiment.store import load_proposal

    names = known_names()
    if isinstance(config.check.proposals, list):
        for k, name in enumerate(config.check.proposals):
            if name not in names:
                raise raw.error(("check", "proposals", k), "one of " + ", ".join(names) + did_you_mean(name, names))
    for key, read in (("saved", load_proposal), ("user", user_function)):
        for k, item in enumerate(getattr(config.check, key)):
            try:
                read(item)
            except InputError as error:
                raise raw.error(("check", key, k), f"{error.allowed} (here: {error.value!r})", item) from None
            except (Exception, SystemExit) as error:  # a user's file may do anything
                problem = f"{type(error).__name__}: {error}"
                raise raw.error(("check", key, k), f"a file that can be run ({problem})", item) from None
    for suite in config.check.suites:
        if SUITES[suite].scope == "once":
            try:
                SUITES[suite].load().parts(**options_of(config, suite))
            except InputError as error:
                raise raw.error(("check", suite, error.field.rpartition(".")[2]), error.allowed) from None

