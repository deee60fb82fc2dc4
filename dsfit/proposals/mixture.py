"""Mixtures of proposals with learnable weights and a defensive share of the uniform sphere."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import torch
from torch import Tensor, nn

from dsfit.arguments import check_directions, check_uniforms, checked
from dsfit.context import Context
from dsfit.errors import InputError, as_number, as_real, check_range
from dsfit.proposals.base import Distribution, ProductDistribution, Proposal
from dsfit.proposals.parameters import Constrained
from dsfit.proposals.split_lobe import SplitGaussianInclination, with_masses
from dsfit.proposals.uniform import UniformSphere

_FEW = 4096


def log_sum_exp(x: Tensor) -> Tensor:
    """log sum exp over the last dimension; -inf entries are allowed, and so are rows of them, with zero gradient."""
    top = x.detach().amax(dim=-1, keepdim=True)
    top = torch.where(torch.isinf(top), 0.0, top)
    total = torch.exp(x - top).sum(dim=-1)
    empty = total == 0
    return torch.where(empty, -math.inf, torch.log(torch.where(empty, 1.0, total)) + top[..., 0])


class MixtureDistribution(Distribution):
    """`p = sum_k w_k p_k` of distributions over the same contexts.

    Args:
        components: the p_k.
        log_weights: log w_k, `[K]` or `[*batch, K]`, normalised by the caller.

    The first uniform selects the component, the others are its own; `dimension = 1 + max_k dimension_k`. A component
    is sampled only where it was selected, if it supports `select`; otherwise everywhere. Samples are differentiable
    in the parameters of the selected component, not in the weights: selection is a step function.
    """

    def __init__(self, components: Sequence[Distribution], log_weights: Tensor) -> None:
        self.components, self.log_weights = list(components), log_weights
        self.batch_shape = self.components[0].batch_shape
        self.dimension = 1 + max(c.dimension for c in self.components)

    def component_log_probs(self, omega: Tensor) -> Tensor:
        """log p_k `[..., K]` of every component."""
        with checked(check_directions(omega, self.batch_shape)):
            parts = [component.log_prob(omega) for component in self._with_masses()]
        return torch.stack(torch.broadcast_tensors(*parts), dim=-1)

    def _with_masses(self) -> list[Distribution]:
        """The components; where contexts are few, those of split Gaussians get their masses together."""
        components = list(self.components)
        if self.batch_shape.numel() <= _FEW:
            laws = {k: c.longitudinal for k, c in enumerate(components) if isinstance(c, ProductDistribution)}
            split = {k: law for k, law in laws.items() if isinstance(law, SplitGaussianInclination)}
            if len(split) > 1:
                for k, law in zip(split, with_masses(list(split.values())), strict=True):
                    components[k] = components[k].with_longitudinal(law)
        return components

    def log_prob(self, omega: Tensor) -> Tensor:
        return log_sum_exp(self.component_log_probs(omega) + self.log_weights)

    def selected(self, u: Tensor) -> Tensor:
        """Index of the component that the uniform `u[...]` selects."""
        edges = torch.exp(self.log_weights.detach()).cumsum(dim=-1)[..., :-1]
        return (u[..., None] >= edges).sum(dim=-1)

    def sample(self, u: Tensor) -> Tensor:
        u = check_uniforms(u, self.dimension, self.batch_shape)
        choice = self.selected(u[..., 0])
        try:
            empty = not bool((choice.flatten()[:1] >= 0).any())
        except RuntimeError:  # under vmap sizes cannot depend on data
            empty = True
        if empty:
            return self._sample_everywhere(u, choice)
        counts = torch.bincount(choice.flatten(), minlength=len(self.components)).tolist()
        flat = u.reshape(-1, u.shape[-1])
        where = {k: torch.nonzero((choice == k).flatten())[:, 0] for k, count in enumerate(counts) if count}
        parts = []
        for k, index in where.items():
            component = self.components[k]
            restricted = self._restrict(component, index)
            if restricted is None:
                parts.append(component.sample(u[..., 1 : 1 + component.dimension]).reshape(-1, 2)[index])
            else:
                parts.append(restricted.sample(flat[index, 1 : 1 + component.dimension]))
        order = torch.cat(list(where.values()))
        back = torch.empty_like(order).scatter_(0, order, torch.arange(len(order), device=order.device))
        return torch.cat(parts)[back].reshape(*choice.shape, 2)

    def _restrict(self, component: Distribution, index: Tensor) -> Distribution | None:
        """The component for the flat sample indices `index` `[N]`, as a distribution with batch shape `[N]`."""
        if len(self.batch_shape) == 0:
            return component
        element = index % self.batch_shape.numel()  # context dimensions are the last ones
        taken: dict[int, tuple[Tensor, Tensor]] = {}  # fields of a component share tensors; kept, so that ids stay

        def take(tensor: Tensor) -> Tensor:
            if tensor.dim() == 0:
                return tensor
            if id(tensor) not in taken:
                taken[id(tensor)] = tensor, tensor.expand(self.batch_shape).reshape(-1)[element]
            return taken[id(tensor)][1]

        return component.select(take)

    def _sample_everywhere(self, u: Tensor, choice: Tensor) -> Tensor:
        drawn = [c.sample(u[..., 1 : 1 + c.dimension]) for c in self.components]
        result = drawn[0]
        for k, omega in enumerate(drawn[1:], start=1):
            result = torch.where((choice == k)[..., None], omega, result)
        return result

    def sample_with_log_prob(self, u: Tensor) -> tuple[Tensor, Tensor]:
        omega = self.sample(u)
        return omega, self.log_prob(omega)

    def select(self, take: Callable[[Tensor], Tensor]) -> MixtureDistribution | None:
        components = [c.select(take) for c in self.components]
        if any(c is None for c in components):
            return None
        weights = self.log_weights
        if weights.dim() > 1:
            weights = torch.stack([take(column) for column in weights.unbind(-1)], dim=-1)
        return MixtureDistribution(components, weights)


class Mixture(Proposal):
    """Mixture with learnable weights: `p = (1 - defensive) sum_k softmax(logits)_k p_k + defensive / (4 pi)`.

    The defensive share of the uniform sphere bounds every weight `f / p` by `4 pi f / defensive`: Gaussian lobes have
    lighter tails than the BSDF, and f^2 / p is only integrable where the tails of p dominate.

    Args:
        components: proposals.
        weights: initial weights, positive, `[K]` or `[*batch, K]`; normalised; equal if left out.
        defensive: share of the uniform sphere, in [0, 1).
        learnable: whether `parameters()` lists the logits. Bijection: softmax.

    Raises:
        InputError: no component, weights of the wrong number or not positive, defensive out of range.

    Example:
        >>> import torch
        >>> from dsfit import Context
        >>> from dsfit.proposals import GaussianLobe, Mixture, Product, UniformAzimuth
        >>> lobes = [Product(GaussianLobe(mean, 0.1), UniformAzimuth()) for mean in (-0.05, 0.05)]
        >>> mixture = Mixture(lobes, weights=[3.0, 1.0], defensive=0.2)
        >>> [round(w, 2) for w in mixture.weights().tolist()]
        [0.6, 0.2]
        >>> u = torch.rand(4, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
        >>> omega, log_p = mixture(Context(0.3)).sample_with_log_prob(u)
        >>> omega.shape, log_p.shape
        (torch.Size([4, 2]), torch.Size([4]))
    """

    logits: Tensor

    def __init__(
        self,
        components: Sequence[Proposal],
        weights: Sequence[float] | Tensor | None = None,
        defensive: float = 0.05,
        *,
        learnable: bool = True,
    ) -> None:
        super().__init__()
        if not components:
            raise InputError("components", components, "at least one proposal")
        defensive = as_number("defensive", defensive, 0.0, 1.0, open_high=True)
        given = torch.ones(len(components)) if weights is None else as_real("weights", weights)
        given = check_range("weights", given.detach().to(torch.float64), 0.0, open_low=True)
        if given.dim() == 0 or given.shape[-1] != len(components):
            raise InputError("weights", tuple(given.shape), f"one weight for each of {len(components)} components")
        self.components = nn.ModuleList(components)
        self.defensive = defensive
        self.sphere = UniformSphere()
        logits = torch.log(given / given.sum(dim=-1, keepdim=True))
        if learnable:
            self.logits = nn.Parameter(logits)
        else:
            self.register_buffer("logits", logits)
        self.learnable = learnable

    def weights(self) -> Tensor:
        """Weights of the components, `[..., K]`; they sum to 1 - defensive."""
        return (1 - self.defensive) * torch.softmax(self.logits, dim=-1)

    def own_constrained(self) -> Constrained:
        """The weights with bounds 0 and 1 - defensive."""
        return {"weights": (self.weights(), 0.0, 1 - self.defensive)} if self.learnable else {}

    def forward(self, context: Context) -> MixtureDistribution:
        log_weights = torch.log_softmax(self.logits, dim=-1) + math.log1p(-self.defensive)
        parts = [component(context) for component in self.components]
        if self.defensive > 0:
            share = torch.full_like(log_weights[..., :1], math.log(self.defensive))
            log_weights = torch.cat([log_weights, share], dim=-1)
            parts.append(self.sphere(context))
        return MixtureDistribution(parts, log_weights.to(context.dtype))

    def log_prob_with_jacobian(self, context: Context, omega: Tensor) -> tuple[Tensor, dict[str, Tensor]]:
        """As for any proposal, but each component is differentiated by itself, in its own parameters alone.

        `d log p / d x_k = r_k d log p_k / d x_k` with the share `r_k = w_k p_k / p` that the component has in the
        density; components that know a faster way use it.
        """
        if self.logits.dim() > 1:
            return super().log_prob_with_jacobian(context, omega)
        parts = [component.log_prob_with_jacobian(context, omega) for component in self.components]
        with torch.no_grad():
            log_weights = torch.log_softmax(self.logits, dim=-1).to(context.dtype) + math.log1p(-self.defensive)
            logs = [value + weight for (value, _), weight in zip(parts, log_weights.unbind(), strict=True)]
            if self.defensive > 0:
                logs.append(self.sphere(context).log_prob(omega) + math.log(self.defensive))
            value = log_sum_exp(torch.stack(torch.broadcast_tensors(*logs), dim=-1))
            base = value.masked_fill(value.isinf(), 0.0)
            shares = torch.stack([torch.exp(x - base) for x in logs[: len(parts)]], dim=-1)
            jacobian: dict[str, Tensor] = {}
            if self.learnable:
                softmax = torch.softmax(self.logits, dim=-1).to(context.dtype)
                jacobian["logits"] = shares - shares.sum(dim=-1, keepdim=True) * softmax
            for k, (_, slopes) in enumerate(parts):
                for name, slope in slopes.items():
                    own = shares[..., k]
                    jacobian[f"components.{k}.{name}"] = (
                        own.reshape(own.shape + (1,) * (slope.dim() - own.dim())) * slope
                    )
        return value, jacobian
