"""What is differentiated: the BSDF in its fibre and in directions; a proposal's density and sampler in everything that
they take; the excess in the proposal's parameters."""

from __future__ import annotations

import copy
import math
from collections.abc import Iterator
from dataclasses import replace

import torch
from torch import Tensor, nn
from torch.func import functional_call

from dsfit.bsdf import DualScattering, Fiber
from dsfit.bsdf.attenuation import forward_backward_energies
from dsfit.bsdf.averages import averages_from_shares
from dsfit.bsdf.snell import Refraction
from dsfit.checks.gradients.compare import MODES_AGREE, DerivativeCheck, Function, check_derivative
from dsfit.context import Context
from dsfit.fit.objectives import Target, excess_residuals
from dsfit.frame import HALF_PI, to_vector
from dsfit.proposals.base import Proposal
from dsfit.proposals.parameters import Given

_VECTORS = ("sigma_a", "alpha", "beta")
_STEPS = {"eccentricity": 0.05, "eta": 0.05, "caustic_max_offset": 0.05}  # rad, and what fits into the ranges
_ROOM = 0.05  # from an end of a field's range
_WAY = "distance"
INTERPOLATED = 1e-9
"""The averages are Chebyshev series on panels that meet to some 1e-12; their slopes jump there by a few hundred times
that."""
_DIRECTIONS = ("theta_i", "theta_r", "phi", "n", "v")


def directions(count: int, generator: torch.Generator, most: float = 1.35) -> dict[str, Tensor]:
    """Random theta_i, theta_r (within +-most), phi, n in (0.5, 4) and v in (0.2, 0.8), each `[count]`.

    theta_diff is spread evenly over all that it can be: glints fade, and their offsets are cut off, at large ones only.
    """

    def draw(low: float, high: float) -> Tensor:
        return low + (high - low) * torch.rand(count, generator=generator, dtype=torch.float64)

    diff = most * ((torch.arange(count) + draw(0.0, 1.0)) * (2 / count) - 1)
    half = draw(-1.0, 1.0) * (most - diff.abs())
    return {
        "theta_i": half - diff,
        "theta_r": half + diff,
        "phi": draw(-math.pi, math.pi),
        "n": draw(0.5, 4.0),
        "v": draw(0.2, 0.8),
    }


def bsdf_in_directions(bsdf: DualScattering, at: dict[str, Tensor]) -> Iterator[DerivativeCheck]:
    """F cos(theta_i) in theta_i, theta_r, phi, n and v, at points `[N]` each."""

    def function(values: dict[str, Tensor]) -> Tensor:
        return bsdf(*torch.broadcast_tensors(*(values[name] for name in _DIRECTIONS)))

    room = {
        "theta_i": 0.5 * (HALF_PI - at["theta_i"].abs()),
        "theta_r": 0.5 * (HALF_PI - at["theta_r"].abs()),
        "n": 0.5 * at["n"],
        "v": 0.5 * torch.minimum(at["v"], 1 - at["v"]),
    }
    for name in _DIRECTIONS:
        step = room.get(name, torch.full_like(at[name], 0.1)).clamp_max(0.1)
        yield check_derivative(function, at, name, own=True, step=step, at_once=True, floor=INTERPOLATED)


def bsdf_in_fiber(bsdf: DualScattering, at: dict[str, Tensor]) -> Iterator[DerivativeCheck]:
    """In every field of the fibre: F_direct without back scattering, N^G, the azimuths of the simplified model where
    they have fields of their own, and what the averages are made of (energies of both halves, and the averages from
    given shares); the integrals between those two are `bsdf_in_averages`.

    Exact azimuths, whatever the BSDF's precision. A value at an end of its range (no absorption) is moved inside, as
    differences need room on both sides.
    """
    base = _inside(bsdf.fiber.to(torch.float64).parameters())
    convention = bsdf.convention
    shares = torch.linspace(0.05, 0.25, 3 * bsdf.channels, dtype=torch.float64).reshape(3, -1)

    def function(values: dict[str, Tensor]) -> Tensor:
        batch = max(x.dim() - (name in _VECTORS) for name, x in values.items())
        fields = {
            name: x.unsqueeze(-2 if name in _VECTORS else -1) if x.dim() - (name in _VECTORS) == 1 else x
            for name, x in values.items()
        }
        fiber = Fiber(**fields)
        angles = at["theta_i"], at["theta_r"], at["phi"]
        diff = (at["theta_r"] - at["theta_i"]) / 2
        # an eccentric fibre's TRT depends on phi_h: give it, so that the eccentricity's derivative is tried too
        phi_h = at["phi"] / 2
        exact = bsdf.replace(fiber=fiber, d_b=0.0, precision="exact")
        parts = [
            exact.direct(*angles, phi_h=phi_h),
            exact.azimuthal_scattered(diff, at["phi"], phi_h=phi_h).flatten(-2),
        ]
        if bsdf.model != "simplified":
            parts.append(bsdf.replace(fiber=fiber, azimuthal="simplified", precision="exact", d_b=0.0).direct(*angles))
        bent = Refraction.at(fiber.eta, diff)
        parts += [x.flatten(-2) for x in forward_backward_energies((bent,) * 3, fiber.sigma_a, convention.absorption)]
        found = averages_from_shares(fiber, convention, shares, 0.5 * shares, bsdf.d_b.to(torch.float64))
        parts += [getattr(found, name) for name in ("beta_f", "alpha_f", "delta_b", "sigma_b")]
        shape = torch.broadcast_shapes(fiber.batch_shape, *(x.shape[:-1] for x in parts))
        result = torch.cat([x.expand(*shape, -1) for x in parts], dim=-1)
        return result if batch else result.reshape(*at["phi"].shape, -1)

    for name, value in base.items():
        step: float = _STEPS.get(name, 0.5 * float(value[value != 0].abs().min()) if bool((value != 0).any()) else 0.1)
        yield check_derivative(function, base, name, step=min(step, 0.1), levels=9, at_once=True)


def _inside(fields: dict[str, Tensor]) -> dict[str, Tensor]:
    """The fields with room on both sides."""
    moved = {name: fields[name].clamp_min(_ROOM) for name in ("sigma_a", "glint_scale", "caustic_max_offset")}
    return {**fields, **moved, "caustic_max_offset": moved["caustic_max_offset"].clamp_max(1 - 2 * _ROOM)}


def bsdf_in_averages(
    bsdf: DualScattering, at: dict[str, Tensor], seed: int, levels: int = 4
) -> Iterator[DerivativeCheck]:
    """All of F cos(theta_i), averages included, along one random direction of sigma_a, eta, alpha and beta each.

    Every step makes the averages' interpolants anew, some seconds each.
    """
    base = bsdf.fiber.to(torch.float64).parameters()
    generator = torch.Generator().manual_seed(seed)
    for name in ("sigma_a", "eta", "alpha", "beta"):
        way = (0.5 + torch.rand(base[name].shape, generator=generator, dtype=torch.float64)) * 0.1

        def function(values: dict[str, Tensor], name: str = name, way: Tensor = way) -> Tensor:
            fiber = Fiber(**{**base, name: base[name] * (1 + values[name] * way)})
            return bsdf.replace(fiber=fiber, precision="exact")(*(at[k] for k in _DIRECTIONS))

        at_zero = {name: torch.zeros((), dtype=torch.float64)}
        yield check_derivative(function, at_zero, name, step=0.2, levels=levels, floor=INTERPOLATED)


def frozen(proposal: Proposal, context: Context) -> Proposal:
    """A copy whose values that are functions of the context, and detached by design, are those at `context`."""
    made = copy.deepcopy(proposal)
    for module in made.modules():
        if isinstance(module, Given) and module.function is not None:
            value = module.function(context).detach().to(torch.float64)
            module.function = None
            module.register_buffer("value", value)
    return made


def log_prob_of(proposal: nn.Module, context: Context, omega: Tensor) -> Function:
    """`log p` at directions `[N, 2]` as a function of parameters by name; with one more dimension in front of a
    parameter, `[B, N]`."""

    def function(values: dict[str, Tensor]) -> Tensor:
        batch = _batch(proposal, values)
        if not batch:
            return functional_call(proposal, values, (context,)).log_prob(omega)
        found = functional_call(proposal, values, (context.expand(*batch),))
        return found.log_prob(omega[:, None]).expand(len(omega), *batch).movedim(0, -1)

    return function


def vectors_of(proposal: nn.Module, context: Context, u: Tensor) -> Function:
    """The sampler `T(u)` as unit vectors, which do not jump where an azimuth wraps, at uniforms `[N, d]`; as
    `log_prob_of`."""

    def function(values: dict[str, Tensor]) -> Tensor:
        batch = _batch(proposal, values)
        if not batch:
            return to_vector(functional_call(proposal, values, (context,)).sample(u))
        found = functional_call(proposal, values, (context.expand(*batch),))
        return to_vector(found.sample(u[:, None].expand(len(u), *batch, -1))).movedim(0, -2)

    return function


def excess_of(proposal: nn.Module, target: Target) -> Function:
    """`M / M* - 1` on quadrature nodes, as fits minimise it; as `log_prob_of`."""
    log_prob = log_prob_of(proposal, target.context, target.omega)

    def function(values: dict[str, Tensor]) -> Tensor:
        return excess_residuals(log_prob(values), target.weight, target.log_best).square().sum(-1)

    return function


def _batch(proposal: nn.Module, values: dict[str, Tensor]) -> tuple[int, ...]:
    """Leading sizes that a value has in excess of its parameter."""
    parameters = dict(proposal.named_parameters())
    for name, value in values.items():
        more = value.dim() - parameters[name].dim()
        if more:
            return tuple(value.shape[:more])
    return ()


def batches(function: Function, values: dict[str, Tensor], name: str) -> bool:
    """Whether a function of a proposal's parameters also takes `name` with one more dimension in front."""
    with torch.no_grad():
        try:
            both = function({**values, name: torch.stack([values[name], values[name] + 1e-3])})
            one = function(values)
            return both.shape == (2, *one.shape) and bool(torch.allclose(both[0], one, rtol=1e-9, atol=1e-9))
        except (RuntimeError, ValueError, IndexError):
            return False


def in_parameters(
    function: Function, proposal: nn.Module, *, step: float = 0.1, each: int = 8, ways: int = 3, seed: int = 0
) -> Iterator[DerivativeCheck]:
    """Any of the functions above in every parameter that requires grad, element by element.

    Above `each` elements in all, along `ways` random directions of all of them together instead: a wrong derivative of
    any element shows in each, at the same sharpness, at a fraction of the time. If one does, every parameter follows.
    """
    values = {name: p.detach() for name, p in proposal.named_parameters()}
    learned = [name for name, p in proposal.named_parameters() if p.requires_grad]
    if sum(values[name].numel() for name in learned) > each:
        wrong = False
        for check in along_random_directions(function, values, learned, step=step, ways=ways, seed=seed):
            wrong = wrong or not (check.worst <= 1 and check.apart <= MODES_AGREE)
            yield check
        if not wrong:
            return
    for name in learned:
        yield check_derivative(function, values, name, step=step, at_once=batches(function, values, name))


def along_random_directions(
    function: Function, values: dict[str, Tensor], names: list[str], *, step: float, ways: int, seed: int
) -> Iterator[DerivativeCheck]:
    """Derivatives along normal random directions in all of `names` together."""
    generator = torch.Generator().manual_seed(seed)
    at_once: bool | None = None
    for k in range(ways):
        way = {n: torch.randn(values[n].shape, generator=generator, dtype=torch.float64) for n in names}

        def moved(at: dict[str, Tensor], way: dict[str, Tensor] = way) -> Tensor:
            t = at[_WAY]
            shift = {name: t.reshape(t.shape + (1,) * values[name].dim()) * way[name] for name in names}
            return function({**values, **{name: values[name] + shift[name] for name in names}})

        at = {_WAY: torch.zeros((), dtype=torch.float64)}
        at_once = batches(moved, at, _WAY) if at_once is None else at_once
        check = check_derivative(moved, at, _WAY, step=0.5 * step, at_once=at_once)
        yield replace(check, name=f"all, direction {k + 1} of {ways}")


def density_in_directions(proposal: nn.Module, context: Context, omega: Tensor) -> Iterator[DerivativeCheck]:
    """`log p` in theta_i and phi_i."""
    distribution = proposal(context)

    def function(values: dict[str, Tensor]) -> Tensor:
        pair = torch.broadcast_tensors(values["theta_i"], values["phi_i"])
        return distribution.log_prob(torch.stack(pair, dim=-1))

    values = {"theta_i": omega[:, 0], "phi_i": omega[:, 1]}
    room = (0.5 * (HALF_PI - omega[:, 0].abs())).clamp_max(0.1)
    yield check_derivative(function, values, "theta_i", own=True, step=room, at_once=True)
    yield check_derivative(function, values, "phi_i", own=True, step=0.1, at_once=True)


def sampler_in_uniforms(proposal: nn.Module, context: Context, u: Tensor) -> Iterator[DerivativeCheck]:
    """`T(u)` in every uniform."""
    distribution = proposal(context)

    def function(values: dict[str, Tensor]) -> Tensor:
        columns = torch.broadcast_tensors(*(values[f"u{k}"] for k in range(u.shape[-1])))
        return to_vector(distribution.sample(torch.stack(columns, dim=-1)))

    values = {f"u{k}": u[:, k] for k in range(u.shape[-1])}
    for name, value in values.items():
        room = (0.5 * torch.minimum(value, 1 - value)).clamp_max(0.05)
        yield check_derivative(function, values, name, own=True, step=room, at_once=True)


def density_in_context(proposal: Proposal, context: Context, omega: Tensor) -> Iterator[DerivativeCheck]:
    """`log p` in theta_r, phi_r and n, with what the proposal freezes at the context held fixed."""
    held = frozen(proposal, context)

    def function(values: dict[str, Tensor]) -> Tensor:
        batch = [x.shape for x in values.values() if x.dim()]
        moved = Context(values["theta_r"], values["phi_r"], values["n"], context.v)
        if not batch:
            return held(moved).log_prob(omega)
        return held(moved).log_prob(omega[:, None]).expand(len(omega), *batch[0]).movedim(0, -1)

    values = {"theta_r": context.theta_r, "phi_r": context.phi_r, "n": context.n + 0.5}
    room = 0.5 * float(HALF_PI - context.theta_r.abs())
    for name, step in (("theta_r", min(0.1, room)), ("phi_r", 0.1), ("n", 0.2)):
        if step > 1e-6:
            yield check_derivative(function, values, name, step=step, at_once=True)
