"""Float32 kernels, compiled where a compiler is found."""

from dsfit.kernels.contexts import Contexts
from dsfit.kernels.hair import HairKernel

__all__ = ["Contexts", "HairKernel"]
