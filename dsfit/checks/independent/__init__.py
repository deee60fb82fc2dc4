"""Independent samples of p* = |F| / int |F| domega by ensemble MCMC, against resampling from every proposal.

Random walks know neither the proposals nor the quadrature: only |F|. Which wrongs are caught by what:

- a sampler that draws something else than its density says, or a density without its Jacobian (off by cos theta):
  marginals and means, because the weights |F| / p are then wrong by a function of the direction; and the bridge;
- a density of the wrong scale (factor 2): only the bridge, whose integral is compared with `dsfit.reference`. Marginals
  and means normalise the weights, and importance sampling is wrong by the same factor;
- a wrong quadrature: means of the chains against means of the quadrature, and every bridge;
- a wrong |F|: nothing of the above, where chains, weights and quadrature share it. Chains may therefore be run on a
  second implementation (`target` of `check`); and at places of the chains the subject's BSDF is compared, without any
  statistics, with its exact mode (tables may be 2e-3 off in the mean) and with `assembly`, which puts it together once
  more (1e-9 anywhere);
- a wrong |F| that all of these share (a wrong N_p, wrong averages): not at all. tests/oracle is there for that.

Outside of the region where a proposal's weights are bounded (`Region`) nothing is said about it: a lobe is judged where
it draws at all, and the share of |F| which that is stands in the finding.

Chains can fail, above all where |F| has lobes far apart and narrow. Then nothing is compared: `Diagnostics` says why,
and every finding is `unclear`.
"""

from __future__ import annotations

from dsfit.checks.independent.chains import Chains, Size, run_ensembles, size_of
from dsfit.checks.independent.comparisons import Bridge, Comparison, Region, bridge, marginals, means, region
from dsfit.checks.independent.diagnostics import Diagnostics, Limits, diagnose
from dsfit.checks.independent.findings import run
from dsfit.checks.independent.resampling import Weighted, draw
from dsfit.checks.independent.verify import Judged, Verification, check, judge_proposal

__all__ = [
    "Bridge",
    "Chains",
    "Comparison",
    "Diagnostics",
    "Judged",
    "Limits",
    "Region",
    "Size",
    "Verification",
    "Weighted",
    "bridge",
    "check",
    "diagnose",
    "draw",
    "judge_proposal",
    "marginals",
    "means",
    "region",
    "run",
    "run_ensembles",
    "size_of",
]
