"""The amortised mixture and light sampling, with shares fitted to how much light comes through around each lobe."""

from __future__ import annotations

import functools
import math
from typing import TYPE_CHECKING, Any, ClassVar

import torch
from torch import Tensor

from dsfit.context import Context
from dsfit.errors import InputError
from dsfit.frame import HALF_PI
from dsfit.kernels.adapters import KernelDistribution
from dsfit.kernels.contexts import Contexts
from dsfit.kernels.geometry import Direction
from dsfit.kernels.layout import FIELDS
from dsfit.proposals.amortised import AmortisedProposal
from dsfit.race.density import DensitySampler
from dsfit.race.peer import Problem, Sampler
from dsfit.render.integrand import HairIntegrand
from dsfit.render.techniques.amortised import Amortised
from dsfit.render.techniques.guide_nodes import Nodes
from dsfit.render.techniques.mixed import LightAt, MixSampler
from dsfit.render.techniques.split import ChosenSampler, SplitSampler
from dsfit.scene.lights import ConstantLight

if TYPE_CHECKING:
    from dsfit.kernels import HairKernel

_AT_ONCE = 1024  # hits whose densities at all guide directions stay in cache
_KEPT = 0.1
"""Part of its first weight that a component keeps whatever the nodes say: they may miss a narrow lobe."""
_LIGHT, _LEAST = 0.25, 0.02
"""First share of light sampling, and the least of it and of the lobes."""
_SHARES = {0.25: 1.2, 0.5: 1.2, 1.0: 0.8}
"""Shares of light sampling that hits choose from, and the cost of a direction with them."""
_TRIAL, _EACH, _PASSES = 384, 32, 8
"""Hits, directions and passes of the trial that compares with light sampling alone."""
_DEARER = 1.2
"""Cost of a direction with fitted weights in units of light sampling alone."""
_PLAIN = {1.0: 1.0, 0.85: 1.2, 0.5: 1.3}
"""Shares of light sampling that the trial chooses from for few samples, and the cost of a direction with them."""
_FIT = {True: 22.0, False: 44.0}
"""Cost of the fit of a hit in the same units, with light at infinity and with nearby lights."""
_DIM = 0.1
"""In the trial hits count by their relative variance; those darker than this part of the root mean square, as if they
were that bright."""
_SCALE, _EDGE = FIELDS.index("log_scale"), FIELDS.index("edge")


class Guided(Amortised):
    """`amortised`, whose hints hold for a hit as a whole, with the weights w_k of the components of every hit, and the
    share of light sampling, fitted to the hit's own surroundings: forward lobes of a hit on the near side of the hair
    count little, because no light comes through the hair behind.

    Nodes at every hit are `rows` x `columns` directions of equal solid angle and `lights` directions of light sampling,
    weighted by the inverse of their density. There f = |F| cos(theta_i) L is evaluated by the kernel, with n from a
    table of the grid (trilinear in the hit's position). Steps `w_k <- w_k sqrt(sum_q f_q^2 p_k(q) / P(q)^2)`,
    normalised, P = sum_k w_k p_k + the uniform share, lower the second moment of the mixture over these nodes, which is
    convex in w (Torsney 1983; He and Owen 2014). Then a hit takes the share of light sampling, of a few, with the least
    product of second moment and cost: light alone at many hits under narrow lights. The nodes only choose weights:
    estimates are unbiased whatever they say.

    A fit costs as much as some tens of directions. A trial on the scene's sample of hits says from how many samples on
    it pays (`worthwhile`, infinite where nothing is gained); fewer are drawn from the light alone, or from the light
    and the mixture as it is, with one share for all hits: whatever does best in the trial (`plain`).

    Args:
        proposal, file, file_seconds, train, training: see `Amortised`.
        rows, columns: of the fixed directions.
        lights: directions of light sampling; 0 leaves light sampling out, and L out of f. Under a constant light there
            are none.
        steps: how many.

    Raises:
        InputError: options out of range; a scene without a kernel, whose tables the fit needs.
    """

    name: ClassVar[str] = "guided"

    def __init__(
        self,
        proposal: AmortisedProposal | None = None,
        file: str | None = None,
        file_seconds: float = 0.0,
        train: bool = False,
        training: dict[str, Any] | None = None,
        rows: int = 5,
        columns: int = 8,
        lights: int = 8,
        steps: int = 3,
    ) -> None:
        super().__init__(proposal, file, file_seconds, train, training)
        for field, value in (("rows", rows), ("columns", columns), ("lights", lights), ("steps", steps)):
            least = 0 if field == "lights" else 1
            if isinstance(value, bool) or not isinstance(value, int) or not least <= value <= 256:
                raise InputError(f"guided.{field}", value, f"an integer in [{least}, 256]")
        self.rows, self.columns, self.lights, self.steps = rows, columns, lights, steps

    def prepare(self, problem: Problem) -> None:
        """The mixture's kernel, and the nodes."""
        super().prepare(problem)
        if self.kernel is None:
            raise InputError("technique", "guided", "float32 and a fibre that kernels serve")
        integrand: HairIntegrand = problem.integrand  # type: ignore[assignment]
        lights = 0 if isinstance(integrand.light, ConstantLight) else self.lights
        self.nodes = Nodes(integrand, self.rows, self.columns, lights, problem.seed)
        self.light, self.plain, self.worthwhile = LightAt(integrand) if lights else None, 1.0, 0.0
        if self.light is not None:
            with torch.no_grad():
                self._try()

    def _try(self) -> None:
        """Find the share for few samples, and the samples from which on the fit pays: by the mean relative variances at
        hits of the scene's sample."""
        generator = torch.Generator().manual_seed(self.problem.seed)
        contexts = self.problem.stream.draw(_TRIAL, generator, dtype=self.problem.dtype)
        samplers = [self._split(contexts), *(self._unfitted(contexts, share) for share in _PLAIN)]
        found = [torch.stack([x.estimate(_EACH, generator) for _ in range(_PASSES)]) for x in samplers]
        size = (sum(x.mean(0) for x in found) / len(found)).square().mean(-1)
        size = size + _DIM * _DIM * size.mean()
        split, *plain = (float((x.var(0).mean(-1) / size).mean()) for x in found)
        products = {share: cost * x for (share, cost), x in zip(_PLAIN.items(), plain, strict=True)}
        self.plain = min(products, key=products.__getitem__)
        gain = products[self.plain] / max(split, 1e-30) - _DEARER
        self.worthwhile = _FIT[self.nodes.far] / gain if gain > 0 else float("inf")

    def at(self, contexts: Context) -> Sampler:
        """Weights of every hit; where there is a light to sample, found when they are needed."""
        if self.light is None:
            return DensitySampler(self.problem, self._mixture_at(contexts)[0], contexts)
        few = self._unfitted(contexts, self.plain)
        return ChosenSampler(few, functools.partial(self._split, contexts), self.worthwhile)

    def _unfitted(self, contexts: Context, share: float) -> Sampler:
        """The light with this share, beside the mixture as its hints make it."""
        assert self.light is not None
        light = self.light(contexts)
        if share == 1:
            return DensitySampler(self.problem, light, contexts)
        pair = [KernelDistribution(self.kernel, contexts), light]
        return MixSampler(self.problem, pair, [1 - share, share], contexts)

    def _split(self, contexts: Context) -> SplitSampler:
        """Lobes and light with the shares that fit every hit."""
        lobes, choice = self._mixture_at(contexts)
        return SplitSampler(self.problem, lobes, self.light, list(_SHARES), choice, contexts)  # type: ignore[arg-type]

    def _mixture_at(self, contexts: Context) -> tuple[KernelDistribution, Tensor]:
        """The mixtures with fitted weights, and the hits' choices of shares of light sampling `[H]`."""
        distribution = KernelDistribution(self.kernel, contexts)
        flat = contexts.reshape(-1)
        starts = range(0, len(flat), _AT_ONCE)
        fits = [self._fitted(distribution.contexts[s : s + _AT_ONCE], flat[s : s + _AT_ONCE]) for s in starts]
        ready, fields = distribution.contexts, torch.cat([fit[0] for fit in fits], dim=-1)
        distribution.contexts = Contexts(ready.theta_r, ready.n, ready.v, fields, ready.sphere, ready.need)
        return distribution, torch.cat([fit[1] for fit in fits])

    def _fitted(self, ready: Contexts, contexts: Context) -> tuple[Tensor, Tensor]:
        """The mixture's fields with the weights fitted to f^2 at the nodes, and which of `_SHARES` hits take."""
        omega, weight, n, v, radiance, light = self.nodes.at(contexts)
        theta_i, phi = omega[..., 0].contiguous(), (contexts.phi_r - omega[..., 1]).contiguous()
        flat = (x.expand(theta_i.shape).reshape(-1) for x in (contexts.theta_r, n, v, theta_i, phi))
        value = self.kernel.eval_each(*flat).reshape(*theta_i.shape, -1)
        squared = weight * (value if radiance is None else value * radiance).square().sum(-1)
        squared = squared / squared.amax(0).clamp_min(torch.finfo(squared.dtype).tiny)
        densities = _densities(self.kernel, ready, theta_i, phi)
        start = torch.diff(ready.fields[_EDGE], dim=0, prepend=torch.zeros_like(ready.fields[_EDGE][:1]))
        sphere = float(ready.sphere)
        ratio, share = _weights(densities, start, sphere, light, squared, self.steps)
        fields = ready.fields.clone()
        fields[_SCALE] += torch.log(ratio.clamp_min(1e-30))
        fields[_EDGE] = (start * ratio).cumsum(0)
        return fields, share


def _densities(kernel: HairKernel, ready: Contexts, theta_i: Tensor, phi: Tensor) -> list[Tensor]:
    """w_k p_k of every component at directions `[Q, H]`, azimuths by the nearest node of their tables."""
    program = kernel.program(ready.need)
    at, layout = Direction.at(theta_i, phi, ready.theta_r), program.layout
    row = (at.diff * ((layout.rows - 1) / HALF_PI) + 0.5).to(torch.int32).clamp_max(layout.rows - 1)
    column = (at.phi * ((layout.columns - 1) / math.pi) + 0.5).to(torch.int32).clamp_max(layout.columns - 1)
    node = (row * layout.columns + column).long()
    tables: dict[int, Tensor] = {}
    mode, below, above, log_scale = ready.fields[:4].unbind()
    over, found = 1 / at.cos_i, []
    for k, law in enumerate(layout.laws):
        x = at.theta_h - mode[k]
        z = x * torch.where(x < 0, below[k], above[k])
        lobe = torch.exp(log_scale[k] - z * z).mul_(over)
        if isinstance(law, int):
            if law not in tables:
                tables[law] = program.tables.records[:, law][node]
            found.append(lobe.mul_(tables[law]))
        else:
            found.append(lobe.mul_(1 / math.pi) if law == "all" else lobe * (at.phi < HALF_PI) * (2 / math.pi))
    return found


def _weights(
    densities: list[Tensor], start: Tensor, sphere: float, light: Tensor | None, squared: Tensor, steps: int
) -> tuple[Tensor, Tensor]:
    """Factors `[K, H]` on the components' weights `start`, and which of `_SHARES` light sampling (density `light`) has,
    `[H]`.

    The mixture of lobes keeps its sum of weights and its uniform share.
    """
    total, ratio = start.sum(0), torch.ones_like(start)
    share = torch.zeros_like(total) if light is None else torch.full_like(total, _LIGHT)
    for _ in range(steps):
        lobes = torch.full_like(squared, sphere)
        for density, own in zip(densities, ratio, strict=True):
            lobes.addcmul_(density, own)
        mix = lobes * (1 - share)
        if light is not None:
            mix.addcmul_(light, share)
        part = squared / mix.square_()
        slope = torch.stack([(density * part).sum(0) for density in densities])
        weight = torch.sqrt(start * slope) * ratio
        weight = weight + _KEPT * start * weight.sum(0)
        weight = weight * (total / weight.sum(0).clamp_min(1e-30))
        if light is not None:
            lit, unlit = (light * part).sum(0), (lobes * part).sum(0)
            own, other = share * torch.sqrt(lit), (1 - share) * torch.sqrt(unlit)
            share = (own / (own + other).clamp_min(1e-30)).clamp(_LEAST, 1 - _LEAST)
        ratio = torch.where(start > 0, weight / start.clamp_min(1e-30), 0.0)
    return ratio, share if light is None else _share(densities, ratio, sphere, light, squared)


def _share(densities: list[Tensor], ratio: Tensor, sphere: float, light: Tensor, squared: Tensor) -> Tensor:
    """Which of `_SHARES` `[H]` has the least product of second moment and cost."""
    lobes = torch.full_like(squared, sphere)
    for density, own in zip(densities, ratio, strict=True):
        lobes.addcmul_(density, own)
    found = []
    for c, cost in _SHARES.items():
        mix = lobes * (1 - c) + light * c
        found.append(cost * torch.where(squared > 0, squared / mix, 0.0).sum(0))
    return torch.stack(found).argmin(0)
