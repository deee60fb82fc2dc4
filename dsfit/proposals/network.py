"""A small smooth network: parameters of a proposal as functions of features of the context."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from dsfit.proposals.parameters import Constrained


def soft(x: Tensor) -> Tensor:
    """x / sqrt(1 + x^2): smooth, odd, bounded by 1; one reciprocal root, so several times cheaper than tanh."""
    return x * torch.rsqrt(1 + x * x)


def bounded(x: Tensor, bound: float) -> Tensor:
    """`bound soft(x / bound)`: x near 0, never beyond the bound."""
    return bound * soft(x / bound)


class Network(nn.Module):
    """Fully connected layers with `soft` between them, `[..., inputs] -> [..., outputs]`; starts at zero output.

    Args:
        sizes: numbers of inputs, of every hidden layer, and of outputs.
        generator: of the first weights.
    """

    def __init__(self, sizes: tuple[int, ...], generator: torch.Generator) -> None:
        super().__init__()
        self.weights, self.biases = nn.ParameterList(), nn.ParameterList()
        for i, (inputs, outputs) in enumerate(zip(sizes[:-1], sizes[1:], strict=True)):
            last = i == len(sizes) - 2
            drawn = torch.randn(outputs, inputs, generator=generator, dtype=torch.float64) / math.sqrt(inputs)
            self.weights.append(nn.Parameter(torch.zeros_like(drawn) if last else drawn))
            self.biases.append(nn.Parameter(torch.zeros(outputs, dtype=torch.float64)))

    def own_constrained(self) -> Constrained:
        """Weights and biases, without bounds."""
        return {name: (value, -math.inf, math.inf) for name, value in self.named_parameters()}

    def forward(self, x: Tensor) -> Tensor:
        """Values at features `[..., inputs]`, in their dtype."""
        for i, (weight, bias) in enumerate(zip(self.weights, self.biases, strict=True)):
            x = nn.functional.linear(soft(x) if i else x, weight.to(x), bias.to(x))
        return x
