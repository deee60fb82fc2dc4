"""Adam over batches of a training set, with a rate that rises for a moment and falls as a cosine."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass

import torch
from torch import Tensor, nn

_WARM = 30


@dataclass(frozen=True)
class Progress:
    """After so many steps and seconds of training: the objective, mean over the steps since the last entry."""

    step: int
    seconds: float
    objective: float


@torch.enable_grad()
def descend(
    parameters: Iterable[nn.Parameter],
    objective: Callable[[Tensor], Tensor],
    count: int,
    generator: torch.Generator,
    *,
    rate: float,
    last_rate: float = 0.0,
    batch: int,
    steps: int | None,
    limit: float = math.inf,
    every: int,
) -> tuple[int, list[Progress]]:
    """Minimise the mean of `objective(rows)` over a training set; returns the number of steps made and their history.

    Args:
        parameters: what is learned.
        objective: of the rows with the indices `[batch]`.
        count: number of rows; they are drawn without replacement, in orders from `generator`.
        rate, last_rate: largest learning rate, and what is left of it at the end.
        batch: rows per step; all of them if there are fewer.
        steps: how many; None: for `limit` seconds.
        every: steps per entry of the history.
    """
    parameters = list(parameters)
    optimiser = torch.optim.Adam(parameters, lr=rate)
    began, done, recent = time.perf_counter(), 0, []
    history: list[Progress] = []
    batch, order = min(batch, count), torch.randperm(count, generator=generator)
    while True:
        share = (time.perf_counter() - began) / limit if steps is None else done / steps if steps else 1.0
        if share >= 1:
            return done, history
        for group in optimiser.param_groups:
            group["lr"] = last_rate + rate * 0.5 * (1 + math.cos(math.pi * share)) * min(1.0, (done + 1) / _WARM)
        if len(order) < batch:
            order = torch.randperm(count, generator=generator)
        rows, order = order[:batch], order[batch:]
        value = objective(rows)
        optimiser.zero_grad()
        value.backward()
        torch.nn.utils.clip_grad_norm_(parameters, 1.0)
        optimiser.step()
        done += 1
        recent.append(float(value.detach()))
        if done % every == 0 or done == steps:
            history.append(Progress(done, time.perf_counter() - began, sum(recent) / len(recent)))
            recent = []
