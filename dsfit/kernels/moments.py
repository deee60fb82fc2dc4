"""What compiled code reads to prepare contexts: moments of the lobes and the network that corrects them."""

from __future__ import annotations

import ctypes
import math
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import pad

from dsfit.proposals.amortised import AmortisedProposal
from dsfit.proposals.lobe_moments import LobeMoments
from dsfit.proposals.network import Network
from dsfit.proposals.parameters import STD_BOUNDS

_NEAR, _FAR, _EIGHT = 16, 32, 8


class Pointers(ctypes.Structure):
    """`Start` of prepare.cpp."""

    _fields_ = [(name, ctypes.c_void_p) for name in ("direct", "scattered", "depths", "network", "sizes")]
    _fields_ += [(name, ctypes.c_int32) for name in ("layers", "widest", "rows", "levels")]
    _fields_ += [(name, ctypes.c_float) for name in ("log_share", "low", "high")]


@dataclass(frozen=True)
class Start:
    """What compiled code is pointed to, and the tensors there, which live as long."""

    tensors: tuple[Tensor, ...]
    pointers: Pointers

    @property
    def address(self) -> int:
        """Of the pointers."""
        return ctypes.addressof(self.pointers)


def is_served(proposal: AmortisedProposal) -> bool:
    """Whether contexts are prepared by the formulas of `AmortisedProposal` itself; kinds of it that see more features
    or read other tables are not."""
    own = type(proposal)
    same = own.shape is AmortisedProposal.shape and own.start is AmortisedProposal.start
    return same and type(proposal.lobes) is LobeMoments and type(proposal.network) is Network


def packed(proposal: AmortisedProposal, components: list[int]) -> Start:
    """Tables and network of a proposal, for these of its components, float32.

    Moments become records of whole cache lines per inclination (and depth). Of the network's outputs those of the
    components are kept; each layer is its biases and then its weights `[inputs, outputs]`, outputs filled up to eights.
    """
    lobes, network = proposal.lobes, proposal.network
    direct, scattered = lobes.direct.flatten(1), lobes.scattered.flatten(2)
    tables = pad(direct, (0, _NEAR - direct.shape[-1])), pad(scattered, (0, _FAR - scattered.shape[-1]))
    layers = [(weight.t(), bias) for weight, bias in zip(network.weights, network.biases, strict=True)]
    weight, bias = layers[-1]
    columns = torch.cat([torch.tensor(components) + f * len(proposal.names) for f in range(4)])
    layers[-1] = weight[:, columns], bias[columns]
    sizes = [len(layers[0][0]), *(len(bias) for _, bias in layers)]
    parts = [pad(x, (0, -x.shape[-1] % _EIGHT)).flatten() for weight, bias in layers for x in (bias, weight)]
    floats = [x.detach().to(torch.float32).contiguous() for x in (*tables, lobes.depths, torch.cat(parts))]
    tensors = (*floats, torch.tensor(sizes, dtype=torch.int32))
    numbers = len(layers), max(-(-size // _EIGHT) * _EIGHT for size in sizes), *scattered.shape[:2]
    share = math.log1p(-proposal.defensive)
    return Start(tensors, Pointers(*(x.data_ptr() for x in tensors), *numbers, share, *STD_BOUNDS))
