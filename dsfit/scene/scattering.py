"""How many fibres the light crosses on its way to the shading point: n(omega_i), and the directly lit share v(omega_i).

With fibres placed independently at random, a ray whose expected number of crossings is n meets none with probability
exp(-n) (Poisson): the share v of the light that arrives unscattered. The thesis instead calls a point lit or not: v = 1
where n <= 1/2.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from typing import Any

import torch
from torch import Tensor, nn

from dsfit.arguments import check_directions
from dsfit.context import Context
from dsfit.errors import InputError, as_number, as_real, check_broadcast, check_choice, check_finite, check_range
from dsfit.frame import TWO_PI, cos_inclination, to_angles, to_vector, wrap
from dsfit.quadrature import gauss_legendre
from dsfit.scene.lights.base import tidy

THRESHOLD = 0.5
"""Of the thesis's rule: fewer expected crossings than this count as none."""


class Scattering(nn.Module, ABC):
    """`scattering(omega_i [..., 2], context) -> (n, v)`: tensors `[...]` in omega_i's dtype.

    Both are differentiable in omega_i and in the scattering's own parameters. v = 1 wherever n = 0.

    Args:
        v: how the directly lit share follows from n: "poisson", v = exp(-n); "threshold", v = 1 where n <= 1/2, else 0;
            or a number (or tensor `[*batch]`) in [0, 1] to use wherever n > 0.
    """

    share: Tensor | None

    def __init__(self, v: Any = "poisson") -> None:
        super().__init__()
        self.rule = check_choice("v", v, ("poisson", "threshold")) if isinstance(v, str) else "constant"
        self.register_buffer("share", None if isinstance(v, str) else check_range("v", as_real("v", v), 0.0, 1.0))

    @abstractmethod
    def crossings(self, omega_i: Tensor, context: Context) -> Tensor:
        """Expected crossings n(omega_i) >= 0."""

    def lit_share(self, n: Tensor, context: Context) -> Tensor:
        """v by the rule."""
        if self.rule == "poisson":
            return torch.exp(-n)
        if self.rule == "threshold":
            return (n <= THRESHOLD).to(n)
        return torch.where(n == 0, 1.0, self.share.to(n))  # type: ignore[union-attr]

    def forward(self, omega_i: Tensor, context: Context) -> tuple[Tensor, Tensor]:
        check_directions(omega_i, context.batch_shape, "omega_i")
        shape = torch.broadcast_shapes(omega_i.shape[:-1], context.batch_shape)
        self._check_batch(shape)
        n = self.crossings(omega_i, context).expand(shape)
        return n, self.lit_share(n, context).expand(shape)

    def _check_batch(self, shape: torch.Size | None = None) -> None:
        """Raise `InputError` unless the parameters broadcast with one another, or to directions of this shape."""
        given = {key: x[..., 0] if key in ("normal", "offset") else x for key, x in self.named_buffers()}
        if shape is None:
            check_broadcast(**given)
        elif check_broadcast(**given, omega_i=torch.empty(shape, device="meta")) != shape:
            shapes = {key: tuple(x.shape) for key, x in given.items()}
            raise InputError(", ".join(shapes), shapes, f"shapes that broadcast to the directions' {tuple(shape)}")

    def breakpoints(self) -> tuple[list[float], list[float]]:
        """Inclinations theta_i and absolute azimuths phi_i where n has a kink or bends sharply."""
        return [], []

    def hints(self, context: Context, how: str = "transmitted") -> Context:
        """The context with a representative n and v in place of its own.

        Args:
            how: "transmitted", the n whose transmittance is the mean one, exp(-n) = mean of exp(-n(omega_i)) over the
                sphere: thin directions count most, as they do in the image; "mean", the plain average of n over the
                sphere; "forward", n and v in the direction of perfect transmission, theta_i = -theta_r and phi = pi. v
                is the average over the sphere in the first two. Sphere averages use 32 x 64 fixed nodes.
        """
        check_choice("how", how, ("transmitted", "mean", "forward"))
        if how == "forward":
            opposite = torch.stack([-context.theta_r, wrap(context.phi_r - math.pi)], dim=-1)
            n, v = self(opposite, context)
            return Context(context.theta_r, context.phi_r, n, v)
        x, w = gauss_legendre(32, context.dtype, context.device)
        phi = (torch.arange(64, dtype=context.dtype, device=context.device) + 0.5) * (TWO_PI / 64) - math.pi
        omega = torch.stack(torch.broadcast_tensors(torch.asin(x)[:, None], phi), dim=-1).flatten(0, 1)
        weight = (w / w.sum() / 64).repeat_interleave(64)
        batch = (1,) * len(context.batch_shape)
        n, v = self(omega.reshape(-1, *batch, 2), context)
        weight = weight.reshape(-1, *batch)
        mean_n = -torch.logsumexp(torch.log(weight) - n, dim=0) if how == "transmitted" else (weight * n).sum(0)
        clear = (n == 0).all(0)
        mean_n = torch.where(clear, 0.0, mean_n.clamp_min(0.0))
        return Context(
            context.theta_r, context.phi_r, mean_n, torch.where(clear, 1.0, (weight * v).sum(0).clamp(0.0, 1.0))
        )


class ConstantScattering(Scattering):
    """The same n and v in every direction.

    Args:
        n: crossings >= 0, a number or `[*batch]`; None: the context's hint n.
        v: directly lit share in [0, 1], or a rule (see `Scattering`); None: the context's hint v if n is None too, else
            1 where n = 0 and 0 elsewhere.

    Raises:
        InputError: out of range, or v < 1 with n = 0 (where no fibre is crossed, everything is directly lit).
    """

    n: Tensor | None

    def __init__(self, n: Any = None, v: Any = None) -> None:
        super().__init__(0.0 if v is None else v)
        self.register_buffer("n", None if n is None else check_range("n", as_real("n", n), 0.0))
        self.from_context = n is None and v is None
        self._check_batch()
        if self.n is not None and v is not None and self.share is not None and ((self.n == 0) & (self.share < 1)).any():
            raise InputError("v", v, "1 where n = 0")

    def crossings(self, omega_i: Tensor, context: Context) -> Tensor:
        return (context.n if self.n is None else self.n).to(omega_i)

    def lit_share(self, n: Tensor, context: Context) -> Tensor:
        return context.v.to(n) if self.from_context else super().lit_share(n, context)


def _thinned(density: Tensor, omega_i: Tensor, aligned: bool) -> Tensor:
    return density * cos_inclination(omega_i[..., 0]) if aligned else density


def _great_circle(axis: Tensor) -> tuple[list[float], list[float]]:
    """Extremes of the circle of directions normal to a fibre-frame vector `[3]`, and where it crosses theta = 0."""
    theta, phi = (x.item() for x in to_angles(axis.detach().to(torch.float64)).unbind(-1))
    if abs(theta) > math.pi / 2 - 1e-9:  # the axis is the tangent: the circle is theta = 0
        return [0.0], []
    top = math.pi / 2 - abs(theta)
    return tidy([-top, top], [phi, phi + math.pi, phi - math.pi / 2, phi + math.pi / 2])


class SlabScattering(Scattering):
    """A point inside a homogeneous layer of fibres between two parallel planes.

    A ray that leaves at an angle to the normal n̂ with c = omega_i . n̂ travels d / |c| in the layer, where d = depth
    for c > 0 and thickness - depth for c < 0; the expected crossings are density x d / |c|. Towards the horizon that
    grows without bound, so it is limited smoothly: `n = m / sqrt(1 + (m c / (density d))^2)` with m = max_n, which is m
    at the horizon from both sides, once continuously differentiable there, and below the true n by a relative (n / m)^2
    / 2 where n is small against m.

    Args:
        thickness: of the layer, > 0; inf for a half-space.
        depth: of the point below the surface that the normal points out of, in [0, thickness]. At depth 0 or full
            depth, n is 0 over one half-space and jumps to m at the horizon.
        density: expected crossings per unit length, >= 0. With `aligned`, per unit length of a ray perpendicular to the
            strands.
        normal: outward normal in the fibre frame, `[3]` or `[*batch, 3]`, normalised here.
        v: see `Scattering`.
        aligned: the strands all run along the fibre's tangent, and crossings are proportional to the sine of the angle
            between ray and strands, cos(theta_i). (Strands of random directions: density already holds the mean of that
            sine, pi/4.)
        max_n: the limit m > 0.

    thickness, depth and density are numbers or tensors `[*batch]` that follow the context's batch; gradients flow to
    them.

    Raises:
        InputError: an argument is out of range.
    """

    thickness: Tensor
    depth: Tensor
    density: Tensor
    normal: Tensor

    def __init__(
        self,
        thickness: Any,
        depth: Any,
        density: Any,
        normal: Any = (0.0, 1.0, 0.0),
        v: Any = "poisson",
        *,
        aligned: bool = False,
        max_n: float = 100.0,
    ) -> None:
        super().__init__(v)
        thickness = as_real("thickness", thickness)
        if thickness.isnan().any() or (thickness <= 0).any():
            raise InputError("thickness", thickness.tolist(), "numbers > 0, or inf")
        depth = check_range("depth", as_real("depth", depth), 0.0)
        check_broadcast(thickness=thickness, depth=depth)
        if (depth > thickness).any():
            raise InputError("depth", depth.tolist(), "numbers in [0, thickness]")
        normal = check_finite("normal", as_real("normal", normal))
        if normal.shape[-1:] != (3,) or (normal.norm(dim=-1) == 0).any():
            raise InputError("normal", normal.tolist(), "vectors [..., 3] of length > 0")
        self.aligned = aligned
        self.max_n = as_number("max_n", max_n, 0.0, open_low=True)
        self.register_buffer("thickness", thickness)
        self.register_buffer("depth", depth)
        self.register_buffer("density", check_range("density", as_real("density", density), 0.0))
        self.register_buffer("normal", normal / normal.norm(dim=-1, keepdim=True))
        self._check_batch()

    def crossings(self, omega_i: Tensor, context: Context) -> Tensor:
        cosine = (to_vector(omega_i) * self.normal.to(omega_i)).sum(-1)
        depth = self.depth.to(omega_i)
        distance = torch.where(cosine >= 0, depth, self.thickness.to(omega_i) - depth)
        density = _thinned(self.density.to(omega_i), omega_i, self.aligned)
        clear = (density == 0) | (distance <= 0)
        # Divided by one after the other: their product is inf in a half-space, and so would the gradient be.
        ratio = self.max_n * cosine / torch.where(clear, 1.0, distance) / torch.where(clear, 1.0, density)
        return torch.where(clear, 0.0, self.max_n * torch.rsqrt(1 + ratio * ratio))

    def breakpoints(self) -> tuple[list[float], list[float]]:
        """The horizon: its extreme inclinations, and its crossings of theta = 0."""
        if self.normal.dim() > 1:
            raise InputError("normal", tuple(self.normal.shape), "one normal to ask for breakpoints")
        return _great_circle(self.normal)

    def extra_repr(self) -> str:
        return f"slab, v={self.rule}, aligned={self.aligned}, max_n={self.max_n:g}"


class SphereScattering(Scattering):
    """A point inside a homogeneous ball of fibres: n = density x chord from the point to the surface along omega_i.

    With p the point's offset from the centre and b = p . omega_i, the chord is `-b + sqrt(b^2 + R^2 - |p|^2)`.

    Args:
        radius: R > 0.
        offset: p in the fibre frame, `[3]` or `[*batch, 3]`, |p| <= R.
        density: expected crossings per unit length, >= 0 (see `SlabScattering` for `aligned`).
        v: see `Scattering`.
        aligned: strands along the tangent: times cos(theta_i).

    radius and density are numbers or tensors `[*batch]`; gradients flow to all parameters. The largest n is 2 R
    density.

    Raises:
        InputError: an argument is out of range.
    """

    radius: Tensor
    offset: Tensor
    density: Tensor

    def __init__(
        self, radius: Any, density: Any, offset: Any = (0.0, 0.0, 0.0), v: Any = "poisson", *, aligned: bool = False
    ) -> None:
        super().__init__(v)
        radius = check_range("radius", as_real("radius", radius), 0.0, open_low=True)
        offset = check_finite("offset", as_real("offset", offset))
        if offset.shape[-1:] != (3,):
            raise InputError("offset", tuple(offset.shape), "shape [..., 3]")
        check_broadcast(radius=radius, offset=offset[..., 0])
        if (offset.norm(dim=-1) > radius * (1 + 4 * torch.finfo(radius.dtype).eps)).any():
            raise InputError("offset", offset.tolist(), "points inside the sphere, |offset| <= radius")
        self.aligned = aligned
        self.register_buffer("radius", radius)
        self.register_buffer("offset", offset)
        self.register_buffer("density", check_range("density", as_real("density", density), 0.0))
        self._check_batch()

    def crossings(self, omega_i: Tensor, context: Context) -> Tensor:
        offset, radius = self.offset.to(omega_i), self.radius.to(omega_i)
        along = (to_vector(omega_i) * offset).sum(-1)
        length = offset.norm(dim=-1)
        power = ((radius - length) * (radius + length)).clamp_min(0.0)
        # The root is 0 only at the horizon of a point on the surface; there the chord is 0 and its gradient is taken as
        # 0.
        square = along * along + power
        inside = square > torch.finfo(square.dtype).tiny
        root = torch.sqrt(torch.where(inside, square, 1.0))
        # For b > 0, -b + root cancels: the other form of the same root.
        outward = along > 0
        chord = torch.where(outward, power / (torch.where(outward, along, 0.0) + root), root - along)
        return _thinned(self.density.to(omega_i), omega_i, self.aligned) * torch.where(inside, chord, 0.0)

    def breakpoints(self) -> tuple[list[float], list[float]]:
        """The horizon of a point in the outer half of the radius, where n bends; empty nearer to the centre."""
        if self.offset.dim() > 1:
            raise InputError("offset", tuple(self.offset.shape), "one offset to ask for breakpoints")
        if self.offset.norm() <= 0.5 * self.radius.max():
            return [], []
        return _great_circle(self.offset)

    def extra_repr(self) -> str:
        return f"sphere, v={self.rule}, aligned={self.aligned}"
