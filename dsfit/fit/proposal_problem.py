"""A proposal's parameters as the unknowns of a `Problem`: objectives over quadrature nodes, with fast per-node
Jacobians."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace

import torch
from torch import Tensor, nn

from dsfit.context import Context
from dsfit.errors import InputError
from dsfit.fit.objectives import Objective, Target
from dsfit.fit.problem import TRANSFORMS, Problem, compress, forward_jacobian

BLOCK = 1 << 17
"""Nodes evaluated at a time."""
CHUNK = 16384
"""Nodes per pass of the reverse-mode Jacobian."""
FORWARD_ELEMENTS = 1 << 17
"""Nodes times columns per pass of the forward-mode Jacobian."""


class Parameters:
    """The learnable parameters of a module as one vector, and back.

    Raises:
        InputError: no parameter has `requires_grad`, or one is not finite.
    """

    def __init__(self, module: nn.Module) -> None:
        named = [(name, p) for name, p in module.named_parameters() if p.requires_grad]
        if not named:
            raise InputError(
                "proposal", type(module).__name__, "a proposal with at least one parameter that requires grad"
            )
        for name, parameter in named:
            if not parameter.is_floating_point():
                raise InputError(f"proposal.{name}", parameter.dtype, "real floating-point parameters")
            if not bool(torch.isfinite(parameter).all()):
                raise InputError(f"proposal.{name}", parameter.tolist(), "finite numbers")
        self.names = [name for name, _ in named]
        self.shapes = [p.shape for _, p in named]
        self.sizes = [p.numel() for _, p in named]
        self.size = sum(self.sizes)
        self.device = named[0][1].device

    def vector(self, module: nn.Module) -> Tensor:
        """The module's parameters as a float64 vector [P] on the CPU."""
        parameters = dict(module.named_parameters())
        return torch.cat([parameters[name].detach().reshape(-1).to("cpu", torch.float64) for name in self.names])

    def split(self, y: Tensor) -> dict[str, Tensor]:
        """Name to parameter; views of `y`, so gradients flow."""
        parts = y.split(self.sizes)
        return {name: part.reshape(shape) for name, part, shape in zip(self.names, parts, self.shapes, strict=True)}

    @torch.no_grad()
    def assign(self, module: nn.Module, y: Tensor) -> None:
        """Write a vector into the module's parameters, in their dtype."""
        parameters = dict(module.named_parameters())
        for name, value in self.split(y).items():
            parameters[name].copy_(value)


class _LogDensity(nn.Module):
    """Log density as one module call, so that parameters put in by functional_call are seen by whatever computes
    lazily."""

    def __init__(self, proposal: nn.Module) -> None:
        super().__init__()
        self.proposal = proposal

    def forward(
        self, context: Context, omega: Tensor, jacobian: bool = False
    ) -> Tensor | tuple[Tensor, dict[str, Tensor]]:
        if jacobian:
            return self.proposal.log_prob_with_jacobian(context, omega)
        return self.proposal(context).log_prob(omega)


@contextmanager
def _no_slow_vmap() -> Iterator[None]:
    """Make vmap raise, instead of looping over nodes, at an operation without a batching rule."""
    library = torch._C._functorch
    before = library._is_vmap_fallback_enabled()
    library._set_vmap_fallback_enabled(False)
    try:
        yield
    finally:
        library._set_vmap_fallback_enabled(before)


class _Block:
    """Targets padded to one number of nodes (with nodes of weight 0), evaluated in one call of batch shape [B]."""

    def __init__(self, targets: Sequence[Target]) -> None:
        most = max(len(t.weight) for t in targets)
        self.targets = list(targets)
        device = targets[0].omega.device
        if len(targets) == 1:
            (target,) = targets
            self.context, self.omega = target.context, target.omega
            self.weight, self.log_best = target.weight, target.log_best
        else:
            pick = [torch.arange(most, device=device).clamp_max(len(t.weight) - 1) for t in targets]
            real = torch.stack([torch.arange(most, device=device) < len(t.weight) for t in targets], -1)
            fields = (
                torch.stack([getattr(t.context, name) for t in targets]) for name in ("theta_r", "phi_r", "n", "v")
            )
            self.context = Context(*fields)
            self.omega = torch.stack([t.omega[i] for t, i in zip(targets, pick, strict=True)], -2)
            self.weight = torch.stack([t.weight[i] for t, i in zip(targets, pick, strict=True)], -1) * real
            self.log_best = torch.stack([t.log_best[i] for t, i in zip(targets, pick, strict=True)], -1)
        self.share = torch.tensor([t.share for t in targets], dtype=torch.float64, device=device)


def _blocks(targets: Sequence[Target]) -> list[_Block]:
    """Contexts of similar numbers of nodes together, `BLOCK` nodes at most."""
    blocks: list[list[Target]] = []
    for target in sorted(targets, key=lambda t: len(t.weight)):
        if blocks and len(target.weight) * (len(blocks[-1]) + 1) <= BLOCK:
            blocks[-1].append(target)
        else:
            blocks.append([target])
    return [_Block(block) for block in blocks]


class ProposalProblem(Problem):
    """The mean of an objective over contexts, as a function of a proposal's parameters.

    Args:
        proposal: module with `proposal(context).log_prob(omega)`, in float64; its parameters are not changed.
        targets: nodes and best densities, one per context; their shares sum to 1.
        objective: what to minimise.
        jacobian: "own", "reverse", "forward" or "auto".

    The Jacobian of N log densities costs about as much as five evaluations by reverse mode, since each node has its
    own scalar (`vmap(grad)` over nodes), and P + 1 by forward mode. A proposal may know a faster way of its own, its
    method `log_prob_with_jacobian`: a mixture differentiates each component in its own parameters alone. "auto" takes
    the first of own and reverse that works and whose J^T r agrees with plain autograd (reverse mode would not if the
    density at one node depended on other nodes); else forward mode.
    """

    def __init__(
        self, proposal: nn.Module, targets: Sequence[Target], objective: Objective, *, jacobian: str = "auto"
    ) -> None:
        self.proposal, self.objective = proposal, objective
        self.targets = list(targets)
        self.parameters = Parameters(proposal)
        self.size, self.least_squares = self.parameters.size, objective.least_squares
        self.gauss_newton = objective.least_squares or type(objective).slope is not Objective.slope
        self.blocks = _blocks(self.targets)
        self.log_density = _LogDensity(proposal)
        self.jacobian = jacobian
        self.device = self.targets[0].omega.device

    def _log_p(self, y: Tensor, context: Context, omega: Tensor) -> Tensor:
        named = {f"proposal.{name}": value for name, value in self.parameters.split(y).items()}
        return torch.func.functional_call(self.log_density, named, (context, omega))

    def _factor(self, y: Tensor, target: Target) -> Tensor | float:
        class Factor(nn.Module):
            def __init__(self, proposal: nn.Module, objective: Objective) -> None:
                super().__init__()
                self.proposal, self.objective = proposal, objective

            def forward(self) -> Tensor | float:
                return self.objective.factor(self.proposal, target)

        if type(self.objective).factor is Objective.factor:
            return 1.0
        named = {f"proposal.{name}": value for name, value in self.parameters.split(y).items()}
        return torch.func.functional_call(Factor(self.proposal, self.objective), named, ())

    def _block_value(self, y: Tensor, block: _Block) -> Tensor:
        log_p = self._log_p(y, block.context, block.omega)
        loss = self.objective.loss(log_p, block.weight, block.log_best).reshape(-1)
        offsets = torch.tensor(
            [self.objective.offset(t) for t in block.targets], dtype=torch.float64, device=loss.device
        )
        factors = [torch.as_tensor(self._factor(y, t), dtype=torch.float64, device=loss.device) for t in block.targets]
        return (block.share * torch.stack(factors) * (loss + offsets)).sum()

    def value(self, y: Tensor) -> float:
        y = y.to(self.device)
        with torch.no_grad():
            return float(sum(self._block_value(y, block) for block in self.blocks))

    def gradient(self, y: Tensor) -> tuple[float, Tensor]:
        return self._gradient(y, self.blocks)

    def sampled_gradient(self, y: Tensor, count: int, generator: torch.Generator) -> tuple[float, Tensor]:
        if count >= len(self.targets):
            return self.gradient(y)
        shares = torch.tensor([target.share for target in self.targets], dtype=torch.float64)
        drawn = torch.multinomial(shares, count, replacement=True, generator=generator)
        # Drawn in proportion to their shares, all count alike.
        chosen = [replace(self.targets[i], share=float(shares.sum()) / count) for i in drawn.tolist()]
        return self._gradient(y, _blocks(chosen))

    def _gradient(self, y: Tensor, blocks: Sequence[_Block]) -> tuple[float, Tensor]:
        y = y.detach().to(self.device).requires_grad_()
        value, gradient = 0.0, torch.zeros_like(y)
        for block in blocks:
            with torch.enable_grad():
                part = self._block_value(y, block)
                if part.requires_grad:
                    (one,) = torch.autograd.grad(part, y, allow_unused=True)
                    gradient = gradient if one is None else gradient + one
            value += float(part.detach())
        return value, gradient.cpu()

    def linearise(self, y: Tensor) -> tuple[Tensor, Tensor]:
        if self.jacobian != "auto":
            return self._linearise(y, self.jacobian)
        own = ["own"] if hasattr(self.proposal, "log_prob_with_jacobian") else []
        for method in (*own, "reverse"):
            try:
                residuals, jacobian = self._linearise(y, method)
                _, gradient = self.gradient(y)
            except RuntimeError:
                continue
            ours, size = 2 * jacobian.T @ residuals, 2 * jacobian.norm(dim=0) * residuals.norm()
            if bool(((ours - gradient).abs() <= 1e-7 * size + 1e-300).all()):
                self.jacobian = method
                return residuals, jacobian
        self.jacobian = "forward"
        return self._linearise(y, "forward")

    def _linearise(self, y: Tensor, method: str) -> tuple[Tensor, Tensor]:
        y = y.detach().to(self.device)
        rows = [self._context_rows(y, target, method) for target in self.targets]
        if len(rows) > 1:
            rows = [compress(torch.cat([r for r, _ in rows]), torch.cat([j for _, j in rows]))]
        return rows[0][0].cpu(), rows[0][1].cpu()

    def _context_rows(self, y: Tensor, target: Target, method: str) -> tuple[Tensor, Tensor]:
        derivative = {"own": self._own, "reverse": self._reverse, "forward": self._forward}[method]
        log_p, jacobian = derivative(y, target)
        leaf = log_p.detach().requires_grad_()
        with torch.enable_grad():
            residuals = self.objective.residuals(leaf, target.weight, target.log_best)
            (slope,) = torch.autograd.grad(residuals.sum(), leaf)
        jacobian = slope[:, None] * jacobian
        residuals = residuals.detach()
        offset = math.sqrt(self.objective.offset(target))
        residuals, jacobian = compress(
            torch.cat([residuals, residuals.new_full((1,), offset)]), torch.cat([jacobian, torch.zeros_like(y)[None]])
        )
        z = y.detach().requires_grad_()
        with torch.enable_grad():
            factor = self._factor(z, target)
            factor = torch.as_tensor(factor, dtype=torch.float64, device=y.device)
            slope = torch.autograd.grad(factor, z, allow_unused=True)[0] if factor.requires_grad else None
        # d(sqrt(c) r) = sqrt(c) dr + r dc / (2 sqrt(c))
        share = target.share * self.objective.slope(float(residuals.square().sum()))
        root = torch.sqrt(factor.detach() * share)
        jacobian = root * jacobian
        if slope is not None:
            jacobian = jacobian + (root / (2 * factor.detach())) * residuals[:, None] * slope
        return root * residuals, jacobian

    def _own(self, y: Tensor, target: Target) -> tuple[Tensor, Tensor]:
        named = {f"proposal.{name}": value for name, value in self.parameters.split(y).items()}
        with TRANSFORMS, _no_slow_vmap(), torch.no_grad():
            arguments = (target.context, target.omega, True)
            log_p, slopes = torch.func.functional_call(self.log_density, named, arguments)
        return log_p, torch.cat([slopes[name].reshape(len(log_p), -1) for name in self.parameters.names], dim=1)

    def _reverse(self, y: Tensor, target: Target) -> tuple[Tensor, Tensor]:
        def one(y: Tensor, omega: Tensor) -> tuple[Tensor, Tensor]:
            log_p = self._log_p(y, target.context, omega)
            return log_p, log_p

        each: Callable = torch.func.vmap(torch.func.grad(one, has_aux=True), (None, 0), chunk_size=CHUNK)
        with TRANSFORMS, _no_slow_vmap(), torch.no_grad():
            jacobian, log_p = each(y, target.omega)
        return log_p, jacobian

    def _forward(self, y: Tensor, target: Target) -> tuple[Tensor, Tensor]:
        def log_p(y: Tensor) -> Tensor:
            return self._log_p(y, target.context, target.omega)

        chunk = max(1, FORWARD_ELEMENTS // max(1, len(target.weight)))
        return forward_jacobian(log_p, y, chunk)
