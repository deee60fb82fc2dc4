"""Estimators that average, weight or pick single proposals, by Monte Carlo."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from dsfit.mis import Balance, contribution
from dsfit.mis.estimators import draw
from dsfit.proposals import CosineHalf, Product, UniformInclination, UniformSphere
from dsfit.proposals.printed import PRINTED
from dsfit.random import uniforms
from experiments._mis_spot import Estimator, Spot, proposals


@dataclass(frozen=True)
class Draws:
    """Samples of every proposal: F `[n, R, C]`, and all log densities `[S, n, R]` there, for each of S proposals."""

    values: list[Tensor]
    log_p: list[Tensor]

    def average(self) -> tuple[Tensor, Tensor]:
        """1/K sum_k F_k `[R, C]` and N x its estimated variance, 1/K sum_k var(F / p_k)."""
        means, variances = zip(
            *(_moments(v * torch.exp(-p[s])[..., None]) for s, (v, p) in enumerate(self)), strict=True
        )
        return torch.stack(means).mean(0), torch.stack(variances).mean(0)

    def balance(self) -> tuple[Tensor, Tensor]:
        """The balance heuristic's estimate of the same samples, and N x its estimated variance."""
        size = len(self.values)
        equal = torch.full((size,), 1 / size, dtype=torch.float64)
        found = [_moments(contribution(v, p, s, equal, Balance())) for s, (v, p) in enumerate(self)]
        return torch.stack([m for m, _ in found]).mean(0), torch.stack([x for _, x in found]).mean(0)

    def __iter__(self) -> Any:
        return zip(self.values, self.log_p, strict=True)


def _moments(z: Tensor) -> tuple[Tensor, Tensor]:
    return z.mean(0), z.var(0)


@torch.no_grad()
def draws(spot: Spot, names: Sequence[str], samples: int, repeats: int, seed: int) -> Draws:
    """`samples` from each proposal, `repeats` times."""
    generator = torch.Generator().manual_seed(seed)
    laws, values, logs = [spot.distributions[name] for name in names], [], []
    for s, law in enumerate(laws):
        omega, log_p = draw(laws, s, uniforms((samples, repeats), law.dimension, generator=generator))
        values.append(spot.integrand(omega, spot.context))
        logs.append(log_p)
    return Draws(values, logs)


def estimators(spot: Spot, names: Sequence[str], best: str) -> dict[str, Estimator]:
    """The average and the balance heuristic of the named proposals, with equal counts, and the best one alone; each
    evaluates no density that it does not need."""

    def laws(chosen: Sequence[str]) -> list[Any]:
        return [proposals(spot.preset)[name](spot.context) for name in chosen]

    def average(samples: int, generator: torch.Generator, chosen: Sequence[str] = names) -> Tensor:
        each, total = samples // len(chosen), torch.zeros(3, dtype=torch.float64)
        for law in laws(chosen):
            omega, log_p = law.sample_with_log_prob(uniforms((each,), law.dimension, generator=generator))
            total = total + (spot.integrand(omega, spot.context) * torch.exp(-log_p)[:, None]).mean(0)
        return total / len(chosen)

    def balance(samples: int, generator: torch.Generator) -> Tensor:
        used, each, total = laws(names), samples // len(names), torch.zeros(3, dtype=torch.float64)
        for s, law in enumerate(used):
            omega, log_p = draw(used, s, uniforms((each,), law.dimension, generator=generator))
            total = total + (spot.integrand(omega, spot.context) * torch.exp(-log_p.logsumexp(0))[:, None]).mean(0)
        return total

    def single(samples: int, generator: torch.Generator) -> Tensor:
        return average(samples, generator, [best])

    return {"average": average, "balance": balance, "best single": single}


@torch.no_grad()
def forms(spot: Spot, samples: int, repeats: int, seed: int) -> list[dict[str, Any]]:
    """Relative means of readings of eqs 2 and 3 with two proposals, of which the first gets three quarters of the
    samples: what is printed, what would be wrong, and printed densities beside corrected ones."""
    fiber = spot.integrand.bsdf.fiber
    shape = {"alpha": float(fiber.alpha[0]), "beta": float(fiber.beta[0])}
    known = proposals(spot.preset)
    cosine = Product(UniformInclination(), CosineHalf())
    pairs: list[tuple[str, str, Any]] = [
        ("M_R, corrected density", "eqs 2, 3", known["M_R"]),
        ("M_R, corrected density", "eq 2 with n_s left out of eq 3", known["M_R"]),
        ("M_R, corrected density", "eq 2 with w = 1/2: the average", known["M_R"]),
        ("M_R, corrected density", "eq 2 with w = 1: no weights", known["M_R"]),
        ("M_R, printed density (20)", "eqs 2, 3", PRINTED["lobe_without_jacobian"](**shape)),
        ("M_R, printed (16)–(20)", "eqs 2, 3", PRINTED["lobe_as_printed"](**shape)),
        ("cos(φ/2), corrected (30), (31)", "eqs 2, 3", cosine),
        ("cos(φ/2), printed (30), (31)", "eqs 2, 3", PRINTED["cosine_as_printed"]()),
    ]
    rows = []
    for index, (name, reading, first) in enumerate(pairs):
        generator = torch.Generator().manual_seed(seed + index)
        laws = [first(spot.context), UniformSphere()(spot.context)]
        total: Tensor | float = 0.0
        for s, n in enumerate((3 * samples // 4, samples // 4)):
            omega, log_p = draw(laws, s, uniforms((n, repeats), laws[s].dimension, generator=generator))
            counts = torch.tensor([0.5, 0.5] if "left out" in reading else [0.75, 0.25], dtype=torch.float64)
            weight = Balance().weights(log_p, counts)[s]
            if "w = " in reading:
                weight = torch.full_like(weight, 0.5 if "1/2" in reading else 1.0)
            value = spot.integrand(omega, spot.context)
            # samples with a claimed density of 0 cannot be used
            term = torch.where(torch.isfinite(log_p[s]), weight * torch.exp(-log_p[s]), 0.0)
            total = total + (value * term[..., None]).mean(0)
        mean = torch.as_tensor(total).sum(-1) / spot.integral.sum()
        rows.append({"density": name, "reading": reading, "mean": float(mean.mean()),
                     "mean_se": float(mean.std() / repeats**0.5)})  # fmt: skip
    return rows
