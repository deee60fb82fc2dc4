"""An environment map in C++: where directions are float32, on the CPU, and no gradients are asked for."""

from __future__ import annotations

import ctypes
import functools
from ctypes import c_int64, c_void_p
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from dsfit.special import is_wrapped

if TYPE_CHECKING:
    from dsfit.scene.lights.environment import EnvironmentLight

_SOURCE = Path(__file__).with_name("environment.cpp")
_TABLES = ("luminance", "column_mass", "row_values", "row_mass", "rises")
_MADE = ("low", "high", "cosine", "image", "row_guide", "column_guide")
_SIZES = ("height", "width", "channels", "stride", "row_buckets", "buckets")


class _Map(ctypes.Structure):
    _fields_ = [*((name, c_void_p) for name in _TABLES + _MADE), *((name, c_int64) for name in _SIZES)]


@functools.cache
def library() -> ctypes.CDLL | None:
    """The compiled functions; None where there is no compiler, or it fails."""
    from dsfit.kernels.compiler import NoCompiler, built  # here: kernels import scenes

    try:
        code = built(_SOURCE.read_text())
    except NoCompiler:
        return None
    head = (c_void_p, c_void_p, c_int64, c_void_p)  # map, rotations, how many, directions or uniforms
    code.dsfit_environment_radiance.argtypes = (*head, c_int64, c_void_p)
    code.dsfit_environment_log_prob.argtypes = (*head, c_int64, c_void_p)
    code.dsfit_environment_sample.argtypes = (*head, c_int64, c_int64, c_void_p)
    code.dsfit_environment_guide.argtypes = (c_void_p, *[c_int64] * 3, c_void_p)
    for name in ("radiance", "log_prob", "sample", "guide"):
        getattr(code, f"dsfit_environment_{name}").restype = None
    return code


class CompiledMap:
    """The tables of a light in the form that C++ reads: its own, its image in float32, and guides to its sums."""

    def __init__(self, light: EnvironmentLight, code: ctypes.CDLL) -> None:
        self.code = code
        height, width, channels = light.image.shape
        stride = 1 if channels == 1 else -(-channels // 4) * 4  # fours of channels are a vector
        image = torch.zeros(height, width + 1, stride)
        image[:, :width, :channels] = light.image.detach() * light.scale
        image[:, width] = image[:, 0]
        half = light.edges / 2
        row_buckets, buckets = 8 * (height + 1), -(-width // 2)
        made = {
            "low": 2 * torch.sin(half) ** 2,
            "high": 2 * torch.cos(half) ** 2,
            "cosine": torch.cos(light.edges),
            "image": image,
            "row_guide": torch.empty(1, row_buckets + 1, dtype=torch.int32),
            "column_guide": torch.empty(height, buckets + 1, dtype=torch.int32),
        }
        # kept, for as long as C++ holds their addresses
        self.tensors = {name: getattr(light, name).contiguous() for name in _TABLES} | made
        self._guide("row_mass", "row_guide", 1, height + 1, row_buckets)
        self._guide("column_mass", "column_guide", height, width, buckets)
        sizes = dict(zip(_SIZES, (height, width, channels, stride, row_buckets, buckets), strict=True))
        self.channels = channels
        self.map = _Map(**{name: x.data_ptr() for name, x in self.tensors.items()}, **sizes)

    def _guide(self, sums: str, guide: str, rows: int, count: int, buckets: int) -> None:
        given, made = (self.tensors[name].data_ptr() for name in (sums, guide))
        self.code.dsfit_environment_guide(given, rows, count, buckets, made)

    def radiance(self, omega: Tensor, rotation: Tensor | None) -> Tensor:
        """`[..., C]` from directions `[..., 2]`."""
        return self._evaluated(self.code.dsfit_environment_radiance, omega, rotation, (self.channels,))

    def log_prob(self, omega: Tensor, rotation: Tensor | None) -> Tensor:
        """`[...]` of directions `[..., 2]`."""
        return self._evaluated(self.code.dsfit_environment_log_prob, omega, rotation, ())

    def sample(self, u: Tensor, rotation: Tensor | None) -> Tensor:
        """Directions `[..., 2]` from uniforms `[..., k]`."""
        u, frames, count = _aligned(u, rotation)
        omega = u.new_empty(*u.shape[:-1], 2)
        self.code.dsfit_environment_sample(
            ctypes.addressof(self.map), frames.data_ptr(), count, u.data_ptr(), u.shape[-1], u[..., 0].numel(),
            omega.data_ptr(),
        )  # fmt: skip
        return omega

    def _evaluated(self, function: Any, omega: Tensor, rotation: Tensor | None, last: tuple[int, ...]) -> Tensor:
        omega, frames, count = _aligned(omega, rotation)
        found = omega.new_empty(*omega.shape[:-1], *last)
        function(
            ctypes.addressof(self.map), frames.data_ptr(), count, omega.data_ptr(), omega[..., 0].numel(),
            found.data_ptr(),
        )  # fmt: skip
        return found


def _aligned(x: Tensor, rotation: Tensor | None) -> tuple[Tensor, Tensor, int]:
    """x `[..., k]`, broadcast with the frames; frames `[F, 3, 3]`, frame i % F of the i-th; F. All contiguous."""
    x = x.detach()
    if rotation is None:
        return x.contiguous(), torch.eye(3), 1
    rotation = rotation.detach().to(torch.float32)
    batch = rotation.shape[:-2]
    if x.shape[:-1][x.dim() - 1 - len(batch) :] != batch or x.dim() - 1 < len(batch):
        shape = torch.broadcast_shapes(x.shape[:-1], batch)
        x = x.expand(*shape, x.shape[-1])
        rotation = rotation.expand(*shape[len(shape) - len(batch) :], 3, 3)
    frames = rotation.reshape(-1, 3, 3).contiguous()
    return x.contiguous(), frames, len(frames)


class Prepared:
    """Holds what was compiled for a light, and is shared by all that share its tables. Copies start empty: addresses
    hold for one set of tables in this process."""

    def __init__(self) -> None:
        self.held: tuple[list[tuple[Tensor, int]], CompiledMap | None] | None = None

    def __reduce__(self) -> tuple[type[Prepared], tuple[()]]:
        return Prepared, ()

    def serving(self, light: EnvironmentLight, x: Tensor) -> CompiledMap | None:
        """What serves the light with directions or uniforms x; None where only torch does."""
        given = [x, light.image, *([] if light.rotation is None else [light.rotation])]
        if x.dtype != torch.float32 or any(t.device.type != "cpu" or is_wrapped(t) for t in given):
            return None
        if torch.is_grad_enabled() and any(t.requires_grad for t in given):
            return None
        if torch.autograd.forward_ad._current_level >= 0:
            return None
        tables = [light.image, *(getattr(light, name) for name in _TABLES)]
        held = self.held
        if held is None or any(
            a is not b or _version(a) != version for a, (b, version) in zip(tables, held[0], strict=True)
        ):
            held = self.held = ([(t, _version(t)) for t in tables], _compiled(light))
        return held[1]


def _version(tensor: Tensor) -> int:
    """How often it was changed in place, where that is counted."""
    return 0 if tensor.is_inference() else tensor._version


def _compiled(light: EnvironmentLight) -> CompiledMap | None:
    """None without a compiler, and for an image that overflows in float32."""
    code = library()
    fits = float(light.image.detach().max()) * light.scale <= torch.finfo(torch.float32).max
    return CompiledMap(light, code) if code is not None and fits else None
