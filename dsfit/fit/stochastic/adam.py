"""Adam on an unbiased gradient of log M from fresh samples, each used once: for streams of contexts and networks.

For each context, with samples of q, m = h / (p q), c = p / q and the score s = dlog p / dy, the gradient of log M is
estimated by

    mean_j (c_j - m_j / M_j) s_j,        M_j = mean of m over the other samples.

`mean(c s)` has mean int dp/dy domega = 0: a control variate that without noise cancels m s / M where p is the best
density. M_j does not know sample j, so its mean is exactly along the gradient, `E[M / M_j]
>= 1` times it; that factor tends to 1 like 1 / samples, and differs from context to context, so contexts with heavy
tails count a little more than others. No derivative passes through the samples: jumps of the integrand do no harm.

Samples are used once, so there is nothing to overfit, and every step's samples judge the proposal before the step.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from dsfit.context import Context
from dsfit.errors import as_number
from dsfit.fit.objectives import LOG_FLOOR
from dsfit.fit.stochastic.samples import Draws
from dsfit.fit.stochastic.setting import Setting


@dataclass(frozen=True)
class Adam:
    """Options.

    Args:
        rate: first learning rate, in units of the parameters; it falls on a cosine over the steps of the fit.
        final_rate: the last.

    Raises:
        InputError: a rate is not positive.
    """

    rate: float = 0.03
    final_rate: float = 3e-4

    def __post_init__(self) -> None:
        for name in ("rate", "final_rate"):
            as_number(name, getattr(self, name), 0.0, open_low=True)

    def start(self, setting: Setting) -> AdamRun:
        """A run of this solver."""
        return AdamRun(self, setting)


def coefficients(drawn: Draws, log_p: Tensor) -> Tensor:
    """`c - m / M_j` `[N, B]`, what each sample's score counts; see the module's text. 0 where h is 0 everywhere."""
    count = len(log_p)
    log_p = log_p.detach().clamp_min(LOG_FLOOR)
    log_m = drawn.log_square - log_p - drawn.log_q
    top = log_m.amax(0)
    top = torch.where(top > -math.inf, top, 0.0)
    m = torch.exp(log_m - top)
    others = (m.sum(0) - m) / max(count - 1, 1)
    # the only sample with light, or nearly so: nothing is known of M without it
    known = others > 1e-6 * m.sum(0) / count
    ratio = torch.where(known, m / torch.where(known, others, 1.0), float(count))
    return torch.where((m > 0).any(0), torch.exp(log_p - drawn.log_q) - torch.where(m > 0, ratio, 0.0), 0.0)


class AdamRun:
    """The state of a run: that of the optimiser."""

    def __init__(self, options: Adam, setting: Setting) -> None:
        self.options, self.setting = options, setting
        self.learned = [p for p in setting.work.parameters() if p.requires_grad]
        self.optimizer = torch.optim.Adam(self.learned, lr=options.rate)
        self.steps = 1
        self.done = False

    def judge(self, drawn: Draws) -> None:
        """Nothing to take back."""

    def advance(self, drawn: Draws, context: Context, step: int) -> None:
        """One step of the optimiser along the gradient from these samples."""
        options = self.options
        share = 0.5 * (1 + math.cos(math.pi * min(step / self.steps, 1.0)))
        self.optimizer.param_groups[0]["lr"] = options.final_rate + share * (options.rate - options.final_rate)
        log_p = self.setting.work(context.to(torch.float64)).log_prob(drawn.omega)
        weight = coefficients(drawn, log_p)
        surrogate = (weight * torch.where(weight == 0, 0.0, log_p.clamp_min(LOG_FLOOR))).mean()
        self.optimizer.zero_grad()
        surrogate.backward()
        if all(p.grad is None or bool(torch.isfinite(p.grad).all()) for p in self.learned):
            self.optimizer.step()

    def state(self) -> dict[str, Any]:
        """Everything to go on from."""
        return {"optimizer": self.optimizer.state_dict()}

    def load(self, state: dict[str, Any]) -> None:
        """Go on from there."""
        self.optimizer.load_state_dict(state["optimizer"])
