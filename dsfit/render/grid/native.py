"""The march in C++."""

from __future__ import annotations

import ctypes
import functools
from ctypes import c_float, c_int64, c_void_p
from pathlib import Path

import torch
from torch import Tensor
from torch.nn.functional import pad

from dsfit.kernels.compiler import NoCompiler, built
from dsfit.render.grid.march import SPREAD, START

__all__ = ["Compiled", "NoCompiler"]

_SOURCE = Path(__file__).with_name("march.cpp")


class _Field(ctypes.Structure):
    _fields_ = [
        ("moments", c_void_p),
        ("size", c_int64 * 3),
        ("low", c_float * 3),
        ("inverse", c_float),
        *((name, c_float) for name in ("voxel", "step", "max_n", "spread")),
    ]


@functools.cache
def library() -> ctypes.CDLL:
    """The compiled march.

    Raises:
        NoCompiler: there is no compiler, or it fails.
    """
    code = built(_SOURCE.read_text())
    code.dsfit_march.argtypes = (c_void_p, c_void_p, c_void_p, c_float, c_int64, c_void_p)
    code.dsfit_march_hits.argtypes = (*[c_void_p] * 6, c_float, c_int64, c_void_p)
    code.dsfit_march.restype = code.dsfit_march_hits.restype = None
    return code


class Compiled:
    """A grid's moments in the form that the C++ march reads: float32, eight numbers a voxel, a border of zeros."""

    def __init__(self, moments: Tensor, low: Tensor, voxel: float, step: float, max_n: float) -> None:
        self.code = library()
        self.moments = pad(moments.detach().to(torch.float32), (0, 2, 1, 1, 1, 1, 1, 1)).contiguous()
        size = (c_int64 * 3)(*self.moments.shape[:3])
        corner = (c_float * 3)(*low.tolist())
        self.field = _Field(self.moments.data_ptr(), size, corner, 1 / voxel, voxel, step, max_n, SPREAD)

    @property
    def memory(self) -> int:
        """Bytes."""
        return self.moments.numel() * self.moments.element_size()

    def march(self, origin: Tensor, direction: Tensor, begin: float = 0.0) -> Tensor:
        """n `[*]` float32 of rays `[*, 3]`, from `begin` voxels on."""
        origin, direction = _plain(origin), _plain(direction)
        n = origin.new_empty(origin.shape[:-1])
        address = ctypes.addressof(self.field)
        self.code.dsfit_march(address, origin.data_ptr(), direction.data_ptr(), begin, n.numel(), n.data_ptr())
        return n

    def march_hits(self, position: Tensor, frame: Tensor, hit: Tensor, theta: Tensor, phi: Tensor) -> Tensor:
        """n `[*]` float32 in directions theta, phi `[*]` of the frames `[H, 3, 3]` at positions `[H, 3]`, both float32
        and contiguous; hit `[*]` int64 says which. Rays start as those from points on fibres do."""
        hit, theta, phi = hit.contiguous(), _plain(theta), _plain(phi)
        n = torch.empty_like(theta)
        given = (position, frame, hit, theta, phi)
        self.code.dsfit_march_hits(
            ctypes.addressof(self.field), *(x.data_ptr() for x in given), START, n.numel(), n.data_ptr()
        )
        return n


def _plain(x: Tensor) -> Tensor:
    return x.detach().to(torch.float32).contiguous()
