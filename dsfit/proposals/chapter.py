"""The chapter's proposals by name, with their parameters taken from a fibre."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from dsfit.context import Context
from dsfit.errors import InputError, check_choice
from dsfit.frame import HALF_PI
from dsfit.proposals.base import Product, Proposal
from dsfit.proposals.gaussian_lobe import GaussianLobe
from dsfit.proposals.lobe import LOBES, Lobe
from dsfit.proposals.scattered_lobe import BackScatterLobe
from dsfit.proposals.transmittance import TransmittanceCosine, TransmittanceGaussian
from dsfit.proposals.uniform import BackHalf, FrontHemisphere, UniformAzimuth, UniformSphere
from dsfit.special import is_wrapped


def _same(a: Tensor, b: Tensor) -> bool:
    return a.dtype == b.dtype and a.device == b.device and a.shape == b.shape and torch.equal(a, b)


class FrozenAverages:
    """Dual scattering averages at the specular guess theta_in = -theta_r: mean over channels, detached.

    A sampler does not know theta_i yet, so what depends on it is evaluated at the mirror direction and kept the same
    in `sample` and in `log_prob`; the density stays exact, only its shape is a guess. The averages of
    the last contexts are kept, because a fit asks for the same ones over and over; make a new object after changing
    the fibre in place.

    Args:
        source: anything with `averages(theta_in)` that returns fields `[..., C]` by name, such as `DualScattering`.
    """

    def __init__(self, source: Any) -> None:
        if not hasattr(source, "averages"):
            raise InputError("averages", type(source).__name__, "an object with a method averages(theta_in)")
        self.source = source
        self._last: tuple[Tensor, dict[str, Tensor]] | None = None

    def __deepcopy__(self, memo: dict[int, Any]) -> FrozenAverages:
        return self  # frozen: copies of a proposal share it

    def get(self, name: str, theta_r: Tensor) -> Tensor:
        """The average `name` at theta_in = -theta_r, mean over channels, of the shape of theta_r."""
        theta_r = theta_r.detach()
        keep = not is_wrapped(theta_r)  # the tensors of a transform do not outlive it
        if keep and self._last is not None and _same(self._last[0], theta_r):
            return self._last[1][name]
        with torch.no_grad():
            averages = self.source.averages(-theta_r)
            values = {key: getattr(averages, key).detach().mean(dim=-1) for key in ("beta_f", "delta_b", "sigma_b")}
        if keep and not any(is_wrapped(value) for value in values.values()):
            self._last = (theta_r.clone(), values)
        return values[name]

    def field(self, name: str) -> AverageOf:
        """The average `name` as a function of the context."""
        return AverageOf(self, name)


class AverageOf:
    """One average as a function of the context: `[*batch]`."""

    def __init__(self, averages: FrozenAverages, name: str) -> None:
        self.averages, self.name = averages, name

    def __call__(self, context: Context) -> Tensor:
        return self.averages.get(self.name, context.theta_r)


def chapter_proposals(
    bsdf_or_fiber: Any, averages: Any = None, *, back_azimuth: str | None = None, learnable: bool = True
) -> dict[str, Proposal]:
    """The proposals that the chapter names, each a fresh module.

    | name | law | chapter |
    |---|---|---|
    | `M_R`, `M_TT`, `M_TRT` | Gaussian lobe in theta_h, uniform azimuth | (12), (16)-(20), figure 2 |
    | `R`, `TRT` | the same lobe, phi from cos(phi/2) | (25)-(31) |
    | `TT` | the same lobe, phi from a wrapped Gaussian | (21)-(24) |
    | `transmittance_cosine` | cos(theta_diff), uniform azimuth | (33)-(35) |
    | `transmittance_gaussian` | Gaussian in theta_i of width 30 degrees, uniform azimuth | in place of (33) |
    | `front` | uniform front hemisphere | (38) |
    | `uniform` | uniform sphere | |
    | `MG_R`, `MG_TT`, `MG_TRT` | widened lobe, azimuth N^G | (9)-(11), (37) |
    | `back` | lobe of f_back, azimuth uniform on the circle or the back half | (7) |

    Args:
        bsdf_or_fiber: a `Fiber` (fields alpha, beta `[3]` and gamma_tt) or a `DualScattering`, whose `fiber` is used.
        averages: what has `averages(theta_in)`; left out, `bsdf_or_fiber` if it has them. Without any, `MG_*` and
            `back` are left out.
        back_azimuth: "all" or "back"; left out, that of the BSDF's convention, else "all".
        learnable: whether the parameters are learned.

    Raises:
        InputError: another back_azimuth, or fibre values outside the bounds of the laws.
    """
    if back_azimuth is None:
        back_azimuth = getattr(getattr(bsdf_or_fiber, "convention", None), "back_azimuth", "all")
    check_choice("back_azimuth", back_azimuth, ("all", "back"))
    fiber = getattr(bsdf_or_fiber, "fiber", bsdf_or_fiber)
    alpha, beta = ([t[..., k] for k in range(3)] for t in (fiber.alpha, fiber.beta))
    free = {"learnable": learnable}
    result: dict[str, Proposal] = {}
    for k, name in enumerate(LOBES):
        result[f"M_{name}"] = Product(GaussianLobe(alpha[k], beta[k], **free), UniformAzimuth())
    for k, name in enumerate(LOBES):
        result[name] = Lobe(name, alpha[k], beta[k], fiber.gamma_tt, **free)
    result["transmittance_cosine"] = Product(TransmittanceCosine(), UniformAzimuth())
    gaussian = TransmittanceGaussian(HALF_PI / 3, variable="in", **free)
    result["transmittance_gaussian"] = Product(gaussian, UniformAzimuth())
    result["front"] = FrontHemisphere()
    result["uniform"] = UniformSphere()
    if averages is None and hasattr(bsdf_or_fiber, "averages"):
        averages = bsdf_or_fiber
    if averages is not None:
        frozen = FrozenAverages(averages)
        for k, name in enumerate(LOBES):
            beta_f = frozen.field("beta_f")
            result[f"MG_{name}"] = Lobe(name, alpha[k], beta[k], fiber.gamma_tt, beta_f=beta_f, **free)
        back = BackScatterLobe(frozen.field("delta_b"), frozen.field("sigma_b"), frozen.field("beta_f"), **free)
        result["back"] = Product(back, BackHalf() if back_azimuth == "back" else UniformAzimuth())
    return result
