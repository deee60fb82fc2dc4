"""`estimate`: the MIS estimate of ∫ F dω for a batch of contexts, with its error, in bounded memory."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import torch
from torch import Tensor, nn

from dsfit.context import Context
from dsfit.errors import InputError, check_choice
from dsfit.mis.allocation import OptimalAllocation, parse_allocation, pilot_fractions, split_counts
from dsfit.mis.combine import Stratum, combine, consistency
from dsfit.mis.estimators import (
    IntegrandFunction,
    contribution,
    control_variates,
    draw,
    draw_mixture,
    evaluate,
)
from dsfit.mis.heuristics import Heuristic, Optimal
from dsfit.mis.heuristics import heuristic as as_heuristic
from dsfit.mis.moments import Moments
from dsfit.random import KINDS, child, uniform_chunks

MODELS = ("multi", "one")
"""Allowed values of `model`."""


@dataclass(frozen=True)
class Estimate:
    """What `estimate` returns; batch shape `[*batch]`, dtype and device of the context.

    Fields:
        value: estimate of ∫ F dω per channel, `[*batch, C]`.
        standard_error: of the value, `[*batch, C]`. Independent uniforms: from the variance within each strategy
            (within the mixture, for the one-sample model); nan if a strategy has a single sample. Sobol and stratified:
            from the spread of the replicates.
        variance: samples x standard_error^2, `[*batch, C]`: the variance per sample.
        samples: directions drawn per context. Sobol and stratified round down to whole replicates.
        evaluations: integrand evaluations in total: (samples + pilot) x contexts.
        seconds: wall-clock time, pilot included, the test for consistency_p_value left out.
        largest_weight: max over samples of |z| / |value|, `[*batch]`, z = w_s F / (c_s p_s) with c_s = n_s / N or the
            probability of s, |.| over channels: how many average samples the largest one counts for. For balance z = F
            / sum_k c_k p_k, so this is a lower bound on the mixture's sup |F| / p in units of the value. The optimal
            heuristic reports that of balance.
        consistency_p_value: `[*batch]`, uniform or conservative if samplers and densities fit each other. With two or
            more strategies, each one is tested against the mixture Q of the others: both estimate the same
            ∫ |F| / P H with H = p_s Q / (p_s + Q), from samples of s by the mean of |F| / P Q / (p_s + Q) and from the
            others' by that of |F| / P p_s / (p_s + Q). H is 0 where one density is, and the factors beside |F| / P
            are at most 1, so this needs neither full support nor more than the finite variance of balance. Welch's t,
            where both means have a relative error under 1/4; the smallest p-value with Sidak's correction. A density
            of wrong scale, without its Jacobian, or not that of its sampler fails as samples grow, unless all are
            wrong by one factor. Otherwise (one strategy, or no overlap): analysis of variance of |F| / P among the
            blocks, which sees only dependence between samples and is conservative for Sobol and stratified. nan where
            nothing can be tested.
        fractions: n_s / N, or the probabilities of the one-sample model.

    Example:
        >>> import torch
        >>> import dsfit
        >>> from dsfit.proposals import UniformSphere
        >>> cosine = dsfit.FunctionIntegrand(lambda omega, context: torch.cos(omega[..., :1]))
        >>> g = torch.Generator().manual_seed(0)
        >>> found = dsfit.estimate(cosine, UniformSphere(), dsfit.Context(0.0), 4096, generator=g)
        >>> round(float(found.variance / found.value**2), 2)  # the excess
        0.08
        >>> found.samples, found.evaluations, found.fractions
        (4096, 4096, (1.0,))
    """

    value: Tensor
    standard_error: Tensor
    variance: Tensor
    samples: int
    evaluations: int
    seconds: float
    largest_weight: Tensor
    consistency_p_value: Tensor
    fractions: tuple[float, ...]


def estimate(
    integrand: IntegrandFunction,
    proposals: nn.Module | Sequence[nn.Module],
    context: Context,
    samples: int,
    heuristic: Any = "balance",
    *,
    generator: torch.Generator,
    model: str = "multi",
    allocation: Any = "equal",
    uniforms: str = "random",
    replicates: int = 16,
    chunk: int = 2**16,
    differentiable: bool = False,
    test: bool = True,
) -> Estimate:
    """Estimate ∫ F(ω) dω over the sphere of directions by multiple importance sampling.

    Thesis chapter eqs 1-3; Veach 1997, chapter 9.

    Args:
        integrand: integrand(omega `[..., 2]`, context) -> `[..., C]`; sample dimensions come first, the batch of
            contexts last.
        proposals: a proposal or several; each `proposal(context)` returns a distribution, evaluated once.
        context: any batch shape; every context gets its own samples.
        samples: N per context, over all strategies.
        heuristic: name, {"kind": name, ...} or object (`dsfit.mis.heuristic`). "optimal" is cross-fitted: with K =
            min(replicates, smallest n_s) folds, each fold uses the alpha of the other folds, so it stays unbiased
            (`dsfit.mis.optimal`).
        generator: source of all random numbers; same state, arguments and device, same result.
        model: "multi": n_s samples from each strategy, estimate `sum_s 1/n_s sum_i w_s F / p_s`; "one": each sample
            chooses a strategy with probability c_s and contributes w_s F / (c_s p_s).
        allocation: n_s or c_s; "equal", counts, fractions, "proportional" or "optimal": see
            `dsfit.mis.allocation.parse_allocation`.
        uniforms: "random", "sobol" or "stratified" (`dsfit.random`).
        replicates: independent randomisations that Sobol and stratified samples are split into; for independent samples
            the number of blocks of the consistency test and folds of the optimal heuristic.
        chunk: most directions (samples x contexts) held at once, unless a single sample of every context is already
            more.
        differentiable: keep the autograd graph of value, through the integrand and the reparametrised samples,
            densities and weights (the pilot, alpha and the choice of strategy are constants). Memory is then no longer
            bounded by `chunk`.
        test: whether to gather what consistency_p_value needs (nan if not): two exponentials and logarithms per sample
            and strategy, to be left out where time is compared and the integrand is cheap.

    Raises:
        InputError: bad arguments; an integrand that is not finite; a weight that is not finite (the message names the
            strategy).

    Example:
        >>> import torch
        >>> import dsfit
        >>> furnace = dsfit.Integrand(dsfit.DualScattering(dsfit.Fiber.preset("blond"), precision="table"))
        >>> context = dsfit.Context(0.3, n=0.0)
        >>> proposals = [dsfit.StructuredProposal(furnace.bsdf, context), dsfit.proposals.UniformSphere()]
        >>> g = torch.Generator().manual_seed(0)
        >>> found = dsfit.estimate(furnace, proposals, context, 4096, generator=g)
        >>> exact = dsfit.reference(furnace, context, 1e-5).value
        >>> bool(((found.value - exact).abs() < 4 * found.standard_error).all())
        True
    """
    start = time.perf_counter()
    rule = as_heuristic(heuristic)
    check_choice("model", model, MODELS)
    check_choice("uniforms", uniforms, KINDS)
    single = isinstance(proposals, nn.Module) or callable(proposals)
    if not single and (not isinstance(proposals, Sequence | nn.ModuleList) or not all(map(callable, proposals))):
        raise InputError("proposals", proposals, "a proposal or a list of at least one")
    proposals = [proposals] if single else list(proposals)
    if not proposals:
        raise InputError("proposals", proposals, "a proposal or a list of at least one")
    if not isinstance(generator, torch.Generator):
        raise InputError("generator", generator, "a torch.Generator")
    quasi = uniforms != "random"
    for field, number, least in (("samples", samples, 1), ("chunk", chunk, 1), ("replicates", replicates, 1 + quasi)):
        if isinstance(number, bool) or not isinstance(number, int) or number < least:
            raise InputError(field, number, f"an integer >= {least}")
    fractions = parse_allocation(allocation, len(proposals), samples)

    with torch.set_grad_enabled(differentiable and torch.is_grad_enabled()):
        distributions = [proposal(context) for proposal in proposals]
        pilot = 0
        if isinstance(fractions, OptimalAllocation):
            fractions, pilot = pilot_fractions(
                fractions, integrand, distributions, context, rule, model, child(generator)
            )
        counts = [samples] if model == "one" else split_counts(samples, fractions)
        if quasi:
            counts = [_per_replicate(n, replicates) for n in counts]
        blocks = replicates if quasi else min(replicates, *(n for n in counts if n), samples)
        if isinstance(rule, Optimal) and blocks < 2:
            raise InputError("samples", samples, "at least 2 per strategy, and 2 replicates, with optimal")
        samples = sum(counts) * (replicates if quasi else 1)
        if model == "multi":
            fractions = [n / sum(counts) for n in counts]
        weights = torch.tensor(fractions, dtype=context.dtype, device=context.device)

        names = [type(proposal).__name__ for proposal in proposals]
        run = partial(_accumulate, integrand, context, weights, rule, names, uniforms, chunk, test)
        strata: list[Stratum] = []
        for s, n in enumerate(counts):
            if n == 0:
                continue
            sizes = [n] * blocks if quasi else [n // blocks + (b < n % blocks) for b in range(blocks)]
            if model == "multi":
                dimension = distributions[s].dimension
                strata.append(run(partial(_draw_own, distributions, s), dimension, sizes, child(generator), (s,)))
            else:
                dimension = 1 + max(d.dimension for d in distributions)
                used = tuple(k for k, c in enumerate(fractions) if c > 0)
                strata.append(
                    run(partial(draw_mixture, distributions, weights), dimension, sizes, child(generator), used)
                )
        shares = weights.new_ones(1) if model == "one" else weights[weights > 0]
        value, standard_error = combine(strata, shares, weights, rule, quasi)
        size = torch.linalg.vector_norm(value.detach(), dim=-1)
        largest = torch.stack([stratum.largest for stratum in strata]).amax(dim=0) / size
    if context.device.type == "cuda":
        torch.cuda.synchronize(context.device)
    seconds = time.perf_counter() - start
    p_value = torch.full_like(size, torch.nan)
    if test:
        p_value = consistency(strata, weights[weights > 0], quasi and model == "multi").to(size)
    return Estimate(
        value=value,
        standard_error=standard_error,
        variance=samples * standard_error.square(),
        samples=samples,
        evaluations=(samples + pilot) * context.batch_shape.numel(),
        seconds=seconds,
        largest_weight=largest,
        consistency_p_value=p_value,
        fractions=tuple(fractions),
    )


def _per_replicate(count: int, replicates: int) -> int:
    if 0 < count < replicates:
        raise InputError("samples", count, f"at least one for each strategy and each of the {replicates} replicates")
    return count // replicates


def _draw_own(distributions: Sequence[Any], strategy: int, u: Tensor) -> tuple[Tensor, Tensor, int]:
    return *draw(distributions, strategy, u), strategy


def _groups(sizes: list[int], most: int) -> list[list[int]]:
    """Runs of blocks of equal size, at most `most` to a run."""
    groups: list[list[int]] = []
    for size in sizes:
        if groups and groups[-1][0] == size and len(groups[-1]) < most:
            groups[-1].append(size)
        else:
            groups.append([size])
    return groups


def _accumulate(
    integrand: IntegrandFunction,
    context: Context,
    fractions: Tensor,
    rule: Heuristic,
    names: Sequence[str],
    kind: str,
    chunk: int,
    testing: bool,
    drawer: Callable[[Tensor], tuple[Tensor, Tensor, int | Tensor]],
    dimension: int,
    sizes: list[int],
    generator: torch.Generator,
    strategies: tuple[int, ...],
) -> Stratum:
    """Moments of one stratum, a piece of samples at a time; cells are `[blocks, *batch]`."""
    contexts = max(1, context.batch_shape.numel())
    options = {"kind": kind, "generator": generator, "dtype": context.dtype, "device": context.device}
    terms, tests, plain = [], [], []
    source = " or ".join(f"proposals[{s}] ({names[s]})" for s in strategies)
    largest = torch.zeros(context.batch_shape, dtype=context.dtype, device=context.device)
    for group in _groups(sizes, max(1, chunk // contexts)):
        shape = (group[0], len(group), *context.batch_shape)
        term: Moments | None = None
        block: Moments | None = None
        test: dict[int, Moments] = {}
        for u in uniform_chunks(shape, dimension, rows=max(1, chunk // (len(group) * contexts)), **options):
            omega, log_p, own = drawer(u)
            value = evaluate(integrand, omega, context, source)
            z = contribution(value, log_p, own, fractions, rule, names)
            if isinstance(rule, Optimal):
                y = torch.cat([z, control_variates(log_p, fractions)], dim=-1)
                term = Moments.of(y, full=True).merge(term)
            else:
                term = Moments.of(z).merge(term)
            with torch.no_grad():
                largest = torch.maximum(largest, torch.linalg.vector_norm(z, dim=-1).flatten(0, 1).amax(dim=0))
                if testing:
                    h, f = _tests(value, log_p, own, fractions)
                    block = Moments.of(f).merge(block)
                    for s in strategies:
                        mask = None if isinstance(own, int) else own == s
                        test[s] = Moments.of(h, mask=mask).merge(test.get(s))
        terms.append(term)
        plain.append(block)
        tests.append(test)
    cells = {s: Moments.cat([test[s] for test in tests]) for s in strategies} if testing else {}
    return Stratum(Moments.cat(terms), cells, Moments.cat(plain) if testing else None, largest)


def _tests(value: Tensor, log_p: Tensor, own: int | Tensor, fractions: Tensor) -> tuple[Tensor, Tensor]:
    """What `consistency` compares: t_s |F| / P for every strategy with samples `[..., U]`, and |F| / P `[..., 1]`.

    For strategy s against the mixture Q_s of the others, t_s = Q_s / (p_s + Q_s) on samples of s and p_s / (p_s + Q_s)
    on all others; both come from the balance weights alone.
    """
    used = torch.nonzero(fractions > 0).flatten()
    share = fractions[used]
    log_q = log_p[used] + torch.log(share).reshape(-1, *[1] * (log_p.ndim - 1))
    log_mix = torch.logsumexp(log_q, dim=0)
    size = torch.linalg.vector_norm(value, dim=-1)
    live = (size > 0) & torch.isfinite(log_mix)
    plain = (size * torch.exp(torch.where(live, -log_mix, -torch.inf))).unsqueeze(-1)
    balance = torch.exp(torch.where(live, log_q - log_mix, -torch.inf)).movedim(0, -1)
    density, rest = balance / share, (1 - balance).clamp_min(0) / (1 - share).clamp_min(torch.finfo(share.dtype).eps)
    mine = (own.unsqueeze(-1) if isinstance(own, Tensor) else own) == used
    return plain * torch.where(mine, rest, density) / (density + rest), plain
