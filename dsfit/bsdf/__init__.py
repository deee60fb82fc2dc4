"""The dual scattering BSDF and its parts."""

from dsfit.bsdf.averages import Averages
from dsfit.bsdf.conventions import CONSISTENT, PRINTED, Convention
from dsfit.bsdf.dual_scattering import DualScattering
from dsfit.bsdf.fiber import Fiber

__all__ = ["CONSISTENT", "PRINTED", "Averages", "Convention", "DualScattering", "Fiber"]
