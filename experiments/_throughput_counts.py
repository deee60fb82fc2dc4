"""What a kernel does per direction, counted while its eager form runs: transcendentals, gathers, arithmetic, bytes."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

TRANSCENDENTAL = {
    "exp", "exp2", "expm1", "log", "log2", "log1p", "sin", "cos", "tan", "asin", "acos", "atan", "atan2", "sinh",
    "cosh", "tanh", "sigmoid", "pow", "erf", "erfc", "erfinv", "logaddexp", "logsumexp", "softplus", "special_ndtri",
    "special_erfcx", "special_log_ndtr", "_softmax", "_log_softmax",
}  # fmt: skip
"""Each counts as one, whatever it costs; logaddexp is two."""
ROOTS = {"sqrt", "rsqrt", "div", "reciprocal"}
GATHERS = {"index", "_unsafe_index", "index_select", "gather", "take", "embedding", "searchsorted"}
PRODUCTS = {"mm", "addmm", "bmm", "baddbmm"}
_FREE = {"view", "reshape", "expand", "select", "slice", "unsqueeze", "squeeze", "permute", "transpose", "t", "unbind",
         "split", "split_with_sizes", "alias", "detach", "_unsafe_view", "as_strided", "unfold", "empty",
         "empty_like", "_local_scalar_dense", "is_same_size", "lift_fresh"}  # fmt: skip


class Counting(TorchDispatchMode):
    """Counts elements by kind of operation. Roots and quotients count apart from other arithmetic: they take ten
    times as long as a product."""

    def __init__(self) -> None:
        super().__init__()
        self.counts: Counter[str] = Counter()

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        result = func(*args, **(kwargs or {}))
        name = func.overloadpacket.__name__.rstrip("_")
        if name not in _FREE:
            self._add(name, [x for x in tree_leaves((args, kwargs)) if isinstance(x, Tensor)], result)
        return result

    def _add(self, name: str, inputs: list[Tensor], result: Any) -> None:
        outputs = [x for x in tree_leaves(result) if isinstance(x, Tensor)]
        size = max((x.numel() for x in outputs), default=0)
        if name in TRANSCENDENTAL:
            self.counts["transcendentals"] += (2 if name == "logaddexp" else 1) * size
            self.counts[f"of {name}"] += size
        elif name in ROOTS:
            self.counts["roots and quotients"] += size
        elif name in GATHERS:
            self.counts["gathers"] += size
        elif name in PRODUCTS:
            self.counts["multiply-adds of matrices"] += size * inputs[-1].shape[-2]
        else:
            self.counts["other"] += size
        self.counts["bytes through memory"] += sum(x.numel() * x.element_size() for x in (*inputs, *outputs))
        self.counts["operations"] += 1


def counted(function: Callable[[], Any], directions: int) -> dict[str, float]:
    """Counts per direction of one call; `operations` and what is counted "of" an operation likewise, except that
    operations are per call."""
    with torch.no_grad(), Counting() as mode:
        function()
    return {key: value if key == "operations" else value / directions for key, value in mode.counts.items()}


def least_bytes(inputs: tuple[Tensor, ...], outputs: tuple[Tensor, ...], directions: int) -> float:
    """Bytes that have to be read and written per direction, each number once."""
    return sum(x.numel() * x.element_size() for x in (*inputs, *outputs)) / directions
