"""Captions of the figures of averaging."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from dsfit.figures import Data


def captions(
    data: Data, averages: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray, np.ndarray]], top: float
) -> dict[str, str]:
    """What the figures show; `averages` gives V of averages and of the best proposal, `top` is the end of the scale."""
    a, record = data.arrays, data.record
    count, contexts, timed = len(record["order"]), len(record["contexts"]), record["timed_proposals"]
    best = np.array([averages(row)[2][-1] for row in a["single"]])
    ratio = a["balance.exact"][:, -1] / best
    means = np.array([averages(row)[0] for row in a["single"]])
    infinite, above = int(np.isinf(means).sum()), int((~(means < top)).sum())
    pairs = a["pairs"]
    ahead, shown = int((pairs[:, 4] < 1).sum()), int((pairs[:, 3] < 1e3).sum())
    where = record["contexts"][0]["preset"]
    growth, sizes = record["growth"], record["timed_samples"]
    variance = np.array(
        [[averages(row)[0][timed - 1], a["balance.exact"][i, timed - 1], best[i]] for i, row in enumerate(a["single"])]
    )
    cost = a["timed.seconds"][:, :, -1] * variance
    cost = cost / cost[:, 2:]
    return {
        "proposals": f"Variance of N samples that the first K of {count} proposals share equally, against the proposal "
        "that joins last; a panel for each context (fibre, inclination of the view, fibres in front), constant light. "
        f"Lines: by quadrature; marks: measured, {record['repeats']} estimates of {record['samples']} samples, ± one "
        f"standard error. Triangles: averages above {top:g}, {infinite} of {above} infinite: one proposal of infinite "
        "variance is enough; weights in inverse proportion to the variances V keep averages finite, but they rise with "
        f"every proposal that is worse. Balance of all {count} has {ratio.min():.2g} to {ratio.max():.2g} times the "
        "variance of the best proposal alone with all N samples (green).",
        "pairs": "Pairs of proposals of finite variance with equal shares, against the ratio of their variances, by "
        f"quadrature: {shown} of {len(pairs)} pairs in {contexts} contexts, the others beyond r = 1000. An average of "
        "N samples in all (orange) is never better than the better proposal alone (green); with N samples of each, "
        f"twice the work, it is where r < 3. The balance heuristic (marks) is better with N in all for {ahead} pairs "
        f"and has at most {pairs[:, 4].max():.3g} times the variance of the better one.",
        "bad": f"What a second, bad proposal (colours; V: its variance alone) does to {record['good']} (grey: alone), "
        f"{where} hair, first context. Left: variance by quadrature over the share of the samples of the bad one; "
        "averages of a bad one with V above 1000 are far beyond the scale or infinite, and not drawn. Right: what one "
        f"measures with equal shares of {growth[0]} to {growth[-1]:,} samples, medians of the estimated variance over "
        "repeats, bars from the lower to the upper quartile: where the average's variance is infinite, what is seen "
        "grows with N, or looks harmless until a rare large weight comes.",
        "time": f"Relative root mean square error against the CPU time of one estimate (median), one thread, of "
        f"{sizes[0]} to {sizes[-1]:,} samples; bars: 95 % intervals from {record['timed_repeats']} estimates. On the "
        "left the fixed cost of a call prevails, which is why more samples take hardly more time there. To the same "
        f"error at the largest number of samples, balance of {timed} proposals takes {_plain(cost[:, 1].min())} to "
        f"{_plain(cost[:, 1].max())} times as long as the best proposal alone, their average "
        f"{_plain(cost[:, 0].min())} to {_plain(cost[:, 0].max())} times; which one is best must be known, though.",
    }


def _plain(value: float) -> str:
    return f"{value:.2g}" if value < 10 else f"{value:.0f}"
