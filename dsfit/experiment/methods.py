"""The methods that a comparison compares: which proposals, how many samples each, which heuristic, and how good that
is by quadrature."""

from __future__ import annotations

import functools
import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor, nn

from dsfit.context import Context
from dsfit.errors import InputError
from dsfit.experiment.amortised_method import amortised, check_amortised
from dsfit.experiment.schema import Config, FittedMethod, HeuristicMixMethod, SingleMethod

if TYPE_CHECKING:
    from dsfit.experiment.reader import ConfigError, RawConfig

NODE_RTOL = 1e-3
FINE_RTOL, FINE_COUNT = 1e-5, 8


class Setting:
    """What all methods of a cell share; nodes and log densities are computed once."""

    def __init__(self, config: Config, integrand: Any, context: Context) -> None:
        self.config, self.integrand, self.context = config, integrand, context
        self.nodes_seconds = 0.0
        self._distributions: dict[int, tuple[nn.Module, Any]] = {}

    @functools.cached_property
    def proposals(self) -> dict[str, nn.Module]:
        """The chapter's proposals for this fibre and the light's, by name."""
        return single_proposals(self.integrand)

    @functools.cached_property
    def nodes(self) -> Any:
        """Quadrature nodes of the integrand at this context; half of them where it is even, as all strategies here
        are."""
        from dsfit.quality import quadrature_nodes

        clock = time.perf_counter()
        found = quadrature_nodes(self.integrand, self.context, rtol=NODE_RTOL, even=True)
        self.nodes_seconds = time.perf_counter() - clock
        return found

    @functools.cached_property
    def fine_nodes(self) -> Any:
        """More nodes, for judging what was fitted on the others."""
        from dsfit.quality import quadrature_nodes

        return quadrature_nodes(self.integrand, self.context, rtol=FINE_RTOL, even=True, count=FINE_COUNT)

    def distribution(self, strategy: nn.Module) -> Any:
        """The strategy's distribution at this context; made once."""
        if id(strategy) not in self._distributions:
            with torch.no_grad():
                self._distributions[id(strategy)] = (strategy, strategy(self.context))
        return self._distributions[id(strategy)][1]

    def log_p(self, strategies: Sequence[nn.Module], nodes: Any = None) -> Tensor:
        """Log densities `[S, Q]` at the nodes (those of the fit unless others are given)."""
        omega = (self.nodes if nodes is None else nodes).omega
        with torch.no_grad():
            return torch.stack([self.distribution(s).log_prob(omega) for s in strategies])


@dataclass
class Plan:
    """A method made concrete for one context.

    Attributes:
        strategies: proposals, and `names` of them.
        fractions: share of the samples of each.
        heuristic, model: as `dsfit.estimate` takes them.
        weights_rule: "equal", "best" or "given", where there are several strategies.
        fit: facts of the fit (of weights or of a whole proposal), or None.
        alpha: coefficients of the optimal heuristic, once known.
        fitted: whether the only strategy is a fitted proposal, to be saved.
    """

    strategies: list[nn.Module]
    names: list[str]
    fractions: list[float] = field(default_factory=lambda: [1.0])
    heuristic: Any = "balance"
    model: str = "multi"
    weights_rule: str | None = None
    fit: dict[str, Any] | None = None
    fitted: bool = False
    alpha: Tensor | None = None

    @property
    def heuristic_name(self) -> str:
        """Name of the heuristic, without its parameters."""
        return self.heuristic if isinstance(self.heuristic, str) else str(self.heuristic["kind"])

    def description(self) -> dict[str, Any]:
        """The plan as plain data."""
        return {
            "strategies": self.names,
            "fractions": self.fractions,
            "heuristic": self.heuristic,
            "model": self.model,
            "weights_rule": self.weights_rule,
            "fit": self.fit,
        }

    def least_samples(self, uniforms: str) -> int:
        """Fewest samples that can be asked for: every strategy gets what the estimator cannot do without.

        That is two samples with the optimal heuristic and one in each of 16 replicates where uniforms are not
        independent; otherwise a strategy with a small share may go without at small sample counts.
        """
        if uniforms != "random":
            return math.ceil(16 / (1 if self.model == "one" else min(self.fractions)))
        if self.heuristic_name == "optimal" and self.model == "multi":
            return math.ceil(2 / min(self.fractions))
        return 2 * len(self.strategies)

    def density(self, omega: Tensor, context: Context) -> Tensor:
        """Density per steradian of all samples together, `sum_s c_s p_s`."""
        log_p = torch.stack([s(context).log_prob(omega) for s in self.strategies])
        log_c = torch.log(torch.tensor(self.fractions, dtype=log_p.dtype))
        return torch.exp(torch.logsumexp(log_p + log_c.reshape(-1, *[1] * (log_p.ndim - 1)), dim=0))


def make_plan(method: Any, setting: Setting) -> Plan:
    """The plan of a method at this context; fits it if it is one."""
    if method.kind == "uniform":
        return Plan([setting.proposals["uniform"]], ["uniform"])
    if method.kind == "light":
        return Plan([setting.proposals["light"]], ["light"])
    if method.kind == "single":
        return _single(method, setting)
    if method.kind == "heuristic_mix":
        return _mix(method, setting)
    if method.kind == "amortised":
        proposal, facts = amortised(method, setting.config)
        return Plan([proposal], ["amortised"], fit=dict(facts))
    return _fitted(method, setting)


def _single(method: SingleMethod, setting: Setting) -> Plan:
    proposal = setting.proposals[method.proposal]
    if not method.defensive:
        return Plan([proposal], [method.proposal])
    uniform = setting.proposals["uniform"]
    return Plan(
        [proposal, uniform],
        [method.proposal, "uniform"],
        [1 - method.defensive, method.defensive],
        model="one",
        weights_rule="given",
    )


def _mix(method: HeuristicMixMethod, setting: Setting) -> Plan:
    names = mix_names(method)
    strategies = [setting.proposals[name] for name in names]
    if method.weights == "best":
        from dsfit.experiment.heuristic_mix import best_mix

        setting.nodes  # noqa: B018  (made before the clock starts, and counted)
        clock = time.perf_counter()
        best = best_mix(setting, strategies, method.heuristic)
        keep = [k for k, c in enumerate(best.fractions) if c > 0]
        total = sum(best.fractions[k] for k in keep)
        fit = {"seconds": setting.nodes_seconds + time.perf_counter() - clock, "tried": best.tried}
        return Plan(
            [strategies[k] for k in keep], [names[k] for k in keep], [best.fractions[k] / total for k in keep],
            best.heuristic, best.model, "best", fit,
        )  # fmt: skip
    given = [1.0] * len(names) if method.weights == "equal" else list(method.weights)
    keep = [k for k, c in enumerate(given) if c > 0]
    total = sum(given)
    fractions = [given[k] / total for k in keep]
    rule = "equal" if method.weights == "equal" else "given"
    return Plan(
        [strategies[k] for k in keep],
        [names[k] for k in keep],
        fractions,
        method.heuristic or "balance",
        method.model,
        rule,
    )


def _fitted(method: FittedMethod, setting: Setting) -> Plan:
    """Fit the family to this context; the fit's time includes its quadrature nodes and the tables of its azimuths."""
    from dsfit.fit.fit import fit
    from dsfit.fit.optimistix_solvers import least_squares  # noqa: F401  (importing JAX is not part of the fit)

    nodes, clock = setting.nodes, time.perf_counter()
    start = structured_start(setting.integrand, setting.context, defensive=method.defensive)
    start_seconds = time.perf_counter() - clock
    if method.max_steps == 0:
        return Plan([start.requires_grad_(False)], [method.family], fit={"seconds": start_seconds})
    options = {"starts": method.starts, "seed": setting.config.estimate.seed, "nodes": nodes}
    if method.max_steps is not None:
        options["max_steps"] = method.max_steps
    found = fit(start, setting.integrand, setting.context, method.objective, method.solver, **options)
    facts = {
        "seconds": setting.nodes_seconds + time.perf_counter() - clock,
        "nodes_seconds": setting.nodes_seconds,
        "start_seconds": start_seconds,
        "nodes": len(nodes.weight),
        "solver": method.solver,
        "objective": method.objective,
        "parameters": sum(p.numel() for p in found.proposal.parameters() if p.requires_grad),
        "steps": len(found.history),
        "reason": str(found.result.reason),
        "converged": found.converged,
        "at_bounds": found.at_bounds,
        "excess_at_nodes": found.excess,
        "mass_at_nodes": found.mass,
    }
    return Plan([found.proposal.requires_grad_(False)], [method.family], fit=facts, fitted=True)


def single_proposals(integrand: Any) -> dict[str, nn.Module]:
    """The chapter's proposals for this fibre and the light's, by name; with nothing to learn."""
    from dsfit.proposals import chapter_proposals

    bsdf = integrand.bsdf
    found = dict(chapter_proposals(bsdf, back_azimuth=bsdf.convention.back_azimuth, learnable=False))
    return {**found, "light": integrand.light.proposal()}


def structured_start(integrand: Any, context: Context, **options: Any) -> nn.Module:
    """The structured family as it starts, with the light's proposal where there is a light to find."""
    from dsfit.proposals.structured import StructuredProposal
    from dsfit.scene import ConstantLight

    light = integrand.light
    extra = {} if isinstance(light, ConstantLight) else {"light": light.proposal()}
    return StructuredProposal(integrand.bsdf, context, extra=extra, **options)


def check_method(raw: RawConfig, index: int, method: Any, config: Config) -> None:
    """Refuse names and combinations that only the library knows.

    Raises:
        ConfigError: naming the method's key.
    """
    from dsfit.experiment.reader import did_you_mean

    def refuse(key: tuple[str | int, ...], allowed: str) -> ConfigError:
        return raw.error(("methods", index, *key), allowed)

    names = (*chapter_names(), "light")
    if isinstance(method, SingleMethod) and method.proposal not in names:
        raise refuse(("proposal",), "one of " + ", ".join(names) + did_you_mean(method.proposal, names))
    if isinstance(method, HeuristicMixMethod):
        chosen = mix_names(method)
        for k, name in enumerate(chosen):
            if name not in names:
                raise refuse(("proposals", k), "one of " + ", ".join(names) + did_you_mean(name, names))
        if len(set(chosen)) < len(chosen):
            raise refuse(("proposals",), "names that differ from each other")
        if isinstance(method.weights, list) and (len(method.weights) != len(chosen) or not sum(method.weights) > 0):
            raise refuse(
                ("weights",), f"{len(chosen)} numbers >= 0 (one for each proposal), not all 0, or 'equal' or 'best'"
            )
        from dsfit.mis import heuristic

        try:
            heuristic(method.heuristic or "balance")
        except InputError as error:
            raise refuse(("heuristic",), f"{error.allowed} ({error.field})") from None
    if method.kind == "amortised":
        check_amortised(raw, index, method, config)
    if isinstance(method, FittedMethod):
        from dsfit.fit.objectives import objective_named
        from dsfit.fit.solvers import solver_named

        try:
            solver_named(method.solver, objective_named(method.objective).least_squares)
        except InputError as error:
            raise refuse(("solver",), error.allowed) from None


def mix_names(method: HeuristicMixMethod) -> list[str]:
    """Names of the proposals that a mix is made of."""
    if isinstance(method.proposals, list):
        return list(method.proposals)
    return [*chapter_names(), *(["light"] if method.proposals == "all" else [])]


@functools.cache
def chapter_names() -> tuple[str, ...]:
    """Names of the chapter's proposals."""
    from dsfit.bsdf import DualScattering, Fiber
    from dsfit.proposals import chapter_proposals

    return tuple(chapter_proposals(DualScattering(Fiber.preset("blond"))))
