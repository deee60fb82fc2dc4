"""What compiled code reads to prepare contexts: moments of the lobes and the network that corrects them."""

from __future__ import annotations

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


@dataclass(frozen=True)
class Start:
    """Tensors that stay alive as long as `arguments`, which point to them in the order of `Start` in prepare.cpp."""

    tensors: tuple[Tensor, ...]
    arguments: tuple


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
    return Start(tensors, (*(x.data_ptr() for x in tensors), *numbers, share, *STD_BOUNDS))
