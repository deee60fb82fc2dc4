"""Proposals: what draws an incident direction, and the density it draws with."""

from dsfit.proposals.adapters import FromDensity, TorchDistribution
from dsfit.proposals.amortised import AmortisedProposal
from dsfit.proposals.azimuth import CosineHalf, Scattered, TruncatedGaussian, WrappedGaussian
from dsfit.proposals.base import Azimuthal, Distribution, Longitudinal, Product, Proposal
from dsfit.proposals.cauchy_lobe import CauchyLobe
from dsfit.proposals.chapter import FrozenAverages, chapter_proposals
from dsfit.proposals.conditional import FiberAzimuth, lobe_azimuths
from dsfit.proposals.deon import DeonProposal
from dsfit.proposals.gaussian_lobe import BoxMullerLobe, GaussianLobe
from dsfit.proposals.lobe import Lobe
from dsfit.proposals.mixture import Mixture, MixtureDistribution
from dsfit.proposals.offset_azimuth import OffsetAzimuth
from dsfit.proposals.ou import OuProposal
from dsfit.proposals.scattered_lobe import BackScatterLobe, ScatteredLobe
from dsfit.proposals.split_lobe import SplitGaussianLobe
from dsfit.proposals.structured import StructuredProposal
from dsfit.proposals.table_2d import Table2D
from dsfit.proposals.table_2d_grid import GridOfTables
from dsfit.proposals.transmittance import TransmittanceCosine, TransmittanceGaussian
from dsfit.proposals.uniform import (
    BackHalf,
    FrontHalf,
    FrontHemisphere,
    UniformAzimuth,
    UniformInclination,
    UniformSphere,
)

__all__ = [
    "AmortisedProposal",
    "Azimuthal",
    "BackHalf",
    "BackScatterLobe",
    "BoxMullerLobe",
    "CauchyLobe",
    "CosineHalf",
    "FiberAzimuth",
    "DeonProposal",
    "Distribution",
    "FromDensity",
    "FrontHalf",
    "FrontHemisphere",
    "FrozenAverages",
    "GaussianLobe",
    "GridOfTables",
    "Lobe",
    "Longitudinal",
    "Mixture",
    "MixtureDistribution",
    "OffsetAzimuth",
    "OuProposal",
    "Product",
    "Proposal",
    "Scattered",
    "ScatteredLobe",
    "SplitGaussianLobe",
    "StructuredProposal",
    "Table2D",
    "TorchDistribution",
    "TransmittanceCosine",
    "TransmittanceGaussian",
    "TruncatedGaussian",
    "UniformAzimuth",
    "UniformInclination",
    "UniformSphere",
    "WrappedGaussian",
    "chapter_proposals",
    "lobe_azimuths",
]
