"""One lobe of the fibre as a proposal: R, TT or TRT, as the chapter has it."""

from __future__ import annotations

from torch import Tensor

from dsfit.errors import InputError, check_choice
from dsfit.proposals.azimuth import CosineHalf, Scattered, WrappedGaussian
from dsfit.proposals.base import Azimuthal, Longitudinal, Product
from dsfit.proposals.gaussian_lobe import GaussianLobe
from dsfit.proposals.scattered_lobe import ScatteredLobe, Value

LOBES = ("R", "TT", "TRT")


class Lobe(Product):
    """M_X times N_X: a Gaussian in theta_h, and cos(phi/2) for R and TRT or a wrapped Gaussian about phi = pi for TT.

    Args:
        name: "R", "TT" or "TRT".
        alpha, beta: centre and width in theta_h, radians; learnable.
        gamma_tt: azimuthal width of TT, radians; learnable; needed for TT only.
        beta_f: if given, the scattered lobe M^G_X N^G_X instead: width `sqrt(beta^2 + n beta_f^2)`, azimuth turned by
            a uniform angle in [-pi/2, pi/2] (chapter eqs (9)-(11)). Takes one more uniform.
        learnable: whether `parameters()` lists alpha, beta and gamma_tt.

    Raises:
        InputError: another name, gamma_tt missing, or a value outside its bounds.

    Source: chapter eqs (12), (21), (25) with the samplers corrected.
    """

    def __init__(
        self,
        name: str,
        alpha: float | Tensor,
        beta: float | Tensor,
        gamma_tt: float | Tensor | None = None,
        *,
        beta_f: Value | None = None,
        learnable: bool = True,
    ) -> None:
        check_choice("name", name, LOBES)
        azimuth: Azimuthal = CosineHalf()
        if name == "TT":
            if gamma_tt is None:
                raise InputError("gamma_tt", None, "a width in radians, for the TT lobe")
            azimuth = WrappedGaussian(gamma_tt, learnable=learnable)
        longitudinal: Longitudinal = GaussianLobe(alpha, beta, learnable=learnable)
        if beta_f is not None:
            longitudinal = ScatteredLobe(alpha, beta, beta_f, learnable=learnable)
            azimuth = Scattered(azimuth)
        super().__init__(longitudinal, azimuth)
        self.name = name
