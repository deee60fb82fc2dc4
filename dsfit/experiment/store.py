"""Saves proposals (and whatever they are made of) as an npz of arrays with a JSON header, and loads them again to
working objects.

No pickle: the header says which `dsfit` classes the object is made of and what their attributes are, and loading
builds only those. Objects that a compact constructor call describes completely (a fibre, a BSDF) are stored as that
call; everything else by its attributes.
"""

from __future__ import annotations

import functools
import hashlib
import importlib
import io
import json
import math
import types
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from dsfit.errors import InputError
from dsfit.experiment.files import read_arrays, write_bytes
from dsfit.experiment.provenance import code_version

PROPOSAL_SCHEMA = 1
_HEADER = "header"
_MODULE_INTERNALS = frozenset(nn.Module().__dict__)
_CALLABLE = ("dsfit.bsdf.fiber:Fiber", "dsfit.bsdf.dual_scattering:DualScattering")
_SCALARS = (bool, int, str, type(None))


def save_proposal(path: str | Path, proposal: nn.Module) -> None:
    """Save a proposal: its class, structure, parameters and tables.

    Parameters keep dtype and `requires_grad`; tensors are stored from the CPU. The file is written atomically.

    Raises:
        InputError: the proposal holds something that is not a tensor, plain data or a `dsfit` object (a lambda, say).

    Example:
        >>> import tempfile
        >>> import dsfit
        >>> from dsfit.proposals import UniformSphere
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     dsfit.save_proposal(f"{folder}/uniform.npz", UniformSphere())
        ...     dsfit.load_proposal(f"{folder}/uniform.npz")
        UniformSphere()
    """
    from dsfit.proposals.base import Proposal

    if not isinstance(proposal, Proposal):
        raise InputError("proposal", type(proposal).__name__, "a dsfit Proposal")
    writer = _Writer()
    root = writer.node(proposal, "proposal")
    header = {"format": "dsfit proposal", "schema_version": PROPOSAL_SCHEMA, "dsfit": code_version(), "root": root}
    header["checksum"] = _checksum(root, writer.arrays)
    arrays = {_HEADER: np.frombuffer(json.dumps(header, allow_nan=False).encode(), dtype=np.uint8), **writer.arrays}
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **arrays)
    write_bytes(path, buffer.getvalue())


def load_proposal(path: str | Path) -> Any:
    """Load a proposal saved by `save_proposal`; it samples and evaluates as the saved one did.

    Raises:
        InputError: the file is missing, truncated or damaged, has another schema version, or needs a class this dsfit
        does not have.

    Example:
        >>> import tempfile
        >>> import dsfit
        >>> from dsfit.proposals import GaussianLobe, Mixture, Product, UniformAzimuth
        >>> mixture = Mixture([Product(GaussianLobe(0.1, 0.2), UniformAzimuth())], defensive=0.1)
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     dsfit.save_proposal(f"{folder}/mixture.npz", mixture)
        ...     again = dsfit.load_proposal(f"{folder}/mixture.npz")
        >>> again.defensive, [type(part).__name__ for part in again.components]
        (0.1, ['Product'])
    """
    from dsfit.proposals.base import Proposal

    allowed = f"a proposal saved by dsfit.save_proposal (schema version {PROPOSAL_SCHEMA})"
    arrays = read_arrays(path)
    try:
        header = json.loads(arrays.pop(_HEADER).tobytes().decode("utf-8"))
        if header["format"] != "dsfit proposal" or header["schema_version"] != PROPOSAL_SCHEMA:
            raise InputError(str(path), f"schema version {header['schema_version']}", allowed)
        if header.get("checksum", None) not in (None, _checksum(header["root"], arrays)):
            raise InputError(str(path), "damaged: contents that do not match their checksum", allowed)
        proposal = _Reader(arrays).value(header["root"])
    except InputError as error:
        raise InputError(str(path), str(error), allowed) from None
    except Exception as error:  # a damaged header can fail anywhere on the way
        raise InputError(str(path), f"damaged: {type(error).__name__}: {error}"[:100], allowed) from None
    if not isinstance(proposal, Proposal):
        raise InputError(str(path), type(proposal).__name__, allowed)
    return proposal


def _checksum(root: Any, arrays: dict[str, np.ndarray]) -> str:
    """SHA-256 of the structure and of every array with its name, dtype and shape."""
    digest = hashlib.sha256(json.dumps(root, sort_keys=True).encode())
    for name, array in sorted(arrays.items()):
        digest.update(f"\0{name} {array.dtype.str} {array.shape}\0".encode() + array.tobytes())
    return digest.hexdigest()


def _compact(value: Any) -> dict[str, Any] | None:
    """Constructor arguments that describe `value` completely, or None."""
    from dsfit.bsdf.dual_scattering import DualScattering
    from dsfit.bsdf.fiber import Fiber

    if isinstance(value, Fiber):
        return dict(value.parameters())
    if type(value) is DualScattering:
        names = ("fiber", "d_f", "d_b", "convention", "precision")
        return {"azimuthal": value.model, **{name: getattr(value, name) for name in names}}
    return None


class _Writer:
    """Turns objects into JSON nodes; arrays go to `arrays`; an object met twice is stored once."""

    def __init__(self) -> None:
        self.arrays: dict[str, np.ndarray] = {}
        self._known: dict[int, tuple[int, Any]] = {}

    def node(self, value: Any, where: str) -> Any:
        if isinstance(value, _SCALARS):
            return value
        if isinstance(value, float):
            return value if math.isfinite(value) else {"float": repr(value)}
        if isinstance(value, torch.Size | tuple | list | set | frozenset):
            name = type(value).__name__ if type(value) in _SEQUENCES.values() else "tuple"
            return {name: [self.node(item, f"{where}[{i}]") for i, item in enumerate(value)]}
        if isinstance(value, torch.dtype):
            return {"dtype": str(value).removeprefix("torch.")}
        if isinstance(value, torch.device):
            return {"device": "cpu"}
        if isinstance(value, dict):
            return {"dict": [[self.node(k, where), self.node(v, f"{where}[{k!r}]")] for k, v in value.items()]}
        if id(value) in self._known:
            return {"same": self._known[id(value)][0]}
        number = len(self._known)
        self._known[id(value)] = (number, value)  # holding the object keeps its id from being used again
        return {"id": number, **self._object(value, where)}

    def _object(self, value: Any, where: str) -> dict[str, Any]:
        if isinstance(value, Tensor):
            key = self._array(value.detach().cpu().numpy())
            return {
                "tensor": key,
                "parameter": isinstance(value, nn.Parameter),
                "grad": value.requires_grad and value.is_leaf,
            }
        if isinstance(value, np.ndarray) and value.dtype != object:
            return {"array": self._array(value)}
        if (
            isinstance(value, type | types.FunctionType)
            and value.__module__.startswith("dsfit.")
            and "<" not in value.__qualname__
        ):
            return {"name": f"{value.__module__}:{value.__qualname__}"}
        if isinstance(value, types.MethodType):
            return {"method": value.__name__, "of": self.node(value.__self__, f"{where}.__self__")}
        if isinstance(value, functools.partial):
            parts = {"args": list(value.args), "keywords": value.keywords}
            return {"partial": self.node(value.func, where), **{k: self.node(v, where) for k, v in parts.items()}}
        cls = type(value)
        if not cls.__module__.startswith("dsfit.") and cls not in (
            nn.ModuleList,
            nn.ModuleDict,
            nn.ParameterList,
            nn.Sequential,
        ):
            raise InputError(where, value, "tensors, plain data and dsfit objects, which alone can be saved")
        name = f"{cls.__module__}:{cls.__qualname__}"
        arguments = _compact(value)
        if arguments is not None:
            return {"call": name, "with": {k: self.node(v, f"{where}.{k}") for k, v in arguments.items()}}
        state = {k: v for k, v in vars(value).items() if k not in _MODULE_INTERNALS or not isinstance(value, nn.Module)}
        entry: dict[str, Any] = {"class": name}
        if isinstance(value, nn.Module):
            entry["training"] = value.training
            for part in ("_parameters", "_buffers", "_modules"):
                entry[part] = {k: self.node(v, f"{where}.{k}") for k, v in getattr(value, part).items()}
        entry["state"] = {k: self.node(v, f"{where}.{k}") for k, v in state.items()}
        return entry

    def _array(self, array: np.ndarray) -> str:
        key = f"a{len(self.arrays)}"
        self.arrays[key] = array
        return key


_SEQUENCES: dict[str, Callable[..., Any]] = {
    "tuple": tuple,
    "list": list,
    "set": set,
    "frozenset": frozenset,
    "Size": torch.Size,
}


class _Reader:
    """The way back from nodes to objects."""

    def __init__(self, arrays: dict[str, np.ndarray]) -> None:
        self.arrays = arrays
        self._known: dict[int, Any] = {}

    def value(self, node: Any) -> Any:
        if isinstance(node, (*_SCALARS, float)):
            return node
        if "same" in node:
            return self._known[node["same"]]
        if "id" in node:
            return self._object(node, node["id"])
        ((kind, content),) = node.items()
        if kind in _SEQUENCES:
            return _SEQUENCES[kind](self.value(item) for item in content)
        if kind == "dict":
            return {self.value(key): self.value(item) for key, item in content}
        if kind == "float":
            return float(content)
        if kind == "dtype":
            dtype = getattr(torch, content)
            if not isinstance(dtype, torch.dtype):
                raise ValueError(f"no dtype {content}")
            return dtype
        if kind == "device":
            return torch.device(content)
        raise ValueError(f"unknown entry {kind}")

    def _object(self, node: dict[str, Any], number: int) -> Any:
        if "tensor" in node:
            tensor = torch.from_numpy(np.array(self.arrays[node["tensor"]]))
            value: Any = (
                nn.Parameter(tensor, node["grad"]) if node["parameter"] else tensor.requires_grad_(node["grad"])
            )
        elif "array" in node:
            value = self.arrays[node["array"]]
        elif "name" in node:
            value = _find(node["name"])
        elif "method" in node:
            value = getattr(self.value(node["of"]), node["method"])
        elif "partial" in node:
            value = functools.partial(
                self.value(node["partial"]), *self.value(node["args"]), **self.value(node["keywords"])
            )
        elif "call" in node:
            if node["call"] not in _CALLABLE:
                raise ValueError(f"{node['call']} is not called when loading")
            value = _find(node["call"])(**{key: self.value(item) for key, item in node["with"].items()})
        else:
            return self._from_state(node, number)
        self._known[number] = value
        return value

    def _from_state(self, node: dict[str, Any], number: int) -> Any:
        cls = _find(node["class"])
        if not isinstance(cls, type):
            raise ValueError(f"{node['class']} is not a class")
        value = cls.__new__(cls)
        self._known[number] = value  # before its parts, which may point back to it
        if isinstance(value, nn.Module):
            nn.Module.__init__(value)
            value.training = node["training"]
            for part in ("_parameters", "_buffers", "_modules"):
                getattr(value, part).update({key: self.value(item) for key, item in node[part].items()})
        for key, item in node["state"].items():
            object.__setattr__(value, key, self.value(item))
        return value


def _find(name: str) -> Any:
    """A class or function of dsfit (or one of torch's plain containers) by `module:qualified name`; nothing else is
    ever looked up."""
    module, _, path = name.partition(":")
    if module.split(".")[0] != "dsfit" and module != "torch.nn.modules.container":
        raise ValueError(f"{name} is not part of dsfit")
    found: Any = importlib.import_module(module)
    for part in path.split("."):
        found = getattr(found, part)
    if getattr(found, "__module__", None) != module:
        raise ValueError(f"{name} is not part of dsfit")
    return found
