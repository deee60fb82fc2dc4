"""dsfit: Monte Carlo rendering of hair that converges faster.

Differentiable dual scattering BSDF, proposal densities, multiple importance sampling, and fits of the proposals to a
reference integrand. See the README for a tour; the names below are the public contract.
"""

from __future__ import annotations

import importlib
from typing import Any

__version__ = "0.1.0"

_PUBLIC = {
    "Amortised": "dsfit.fit.amortise",
    "AmortisedProposal": "dsfit.proposals",
    "Averages": "dsfit.bsdf",
    "Context": "dsfit.context",
    "ContextRange": "dsfit.scene.plan",
    "ContextStream": "dsfit.streams",
    "Convention": "dsfit.bsdf",
    "DualScattering": "dsfit.bsdf",
    "Estimate": "dsfit.mis",
    "FamilyProposal": "dsfit.proposals.family",
    "Fiber": "dsfit.bsdf",
    "FiberFamily": "dsfit.proposals.fiber_family",
    "Fit": "dsfit.fit",
    "FunctionIntegrand": "dsfit.scene",
    "HairKernel": "dsfit.kernels",
    "HeldOut": "dsfit.fit.amortise",
    "InputError": "dsfit.errors",
    "Integrand": "dsfit.scene",
    "Material": "dsfit.material",
    "Nodes": "dsfit.quality",
    "StructuredProposal": "dsfit.proposals",
    "amortise": "dsfit.fit.amortise",
    "estimate": "dsfit.mis",
    "excess": "dsfit.quality",
    "fit": "dsfit.fit",
    "fit_stochastic": "dsfit.fit",
    "held_out": "dsfit.fit.amortise",
    "load_proposal": "dsfit.experiment",
    "plan": "dsfit.scene.plan",
    "quadrature_nodes": "dsfit.quality",
    "reference": "dsfit.quality",
    "save_proposal": "dsfit.experiment",
    "train_family": "dsfit.fit.amortise.family",
}

__all__ = sorted(_PUBLIC)


def __getattr__(name: str) -> Any:
    """Public names are loaded when first used, so that `import dsfit` costs little more than `import torch`."""
    if name not in _PUBLIC:
        raise AttributeError(f"module 'dsfit' has no attribute {name!r}")
    module = importlib.import_module(_PUBLIC[name])
    # the package `dsfit.fit` can itself be called, so the name is the package wherever it was imported first
    value = module if module.__name__ == f"{__name__}.{name}" else getattr(module, name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted([*globals(), *_PUBLIC])
