"""`write_header`: a BSDF and its fitted proposal as one C++ file."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
import torch

from dsfit.bsdf.conventions import CONSISTENT, Convention
from dsfit.bsdf.dual_scattering import DualScattering
from dsfit.context import Context
from dsfit.errors import InputError
from dsfit.experiment.files import write_bytes
from dsfit.experiment.provenance import code_version
from dsfit.export.render import check_namespace, header_text, source
from dsfit.export.tables import make_tables
from dsfit.proposals.amortised import AmortisedProposal
from dsfit.quality import reference
from dsfit.scene.integrand import Integrand

KNOWN = ((0.0, 0.0, 1.0), (0.7, 0.0, 1.0), (-1.2, 0.0, 1.0), (0.35, 3.0, 0.0), (-0.9, 10.0, 0.0), (1.45, 2.5, 0.3))
"""theta_r, n and v of the albedos that a header carries."""
_RTOL = 1e-6
_DEGREES = ("alpha", "beta", "caustic_width", "gamma_tt")


@dataclass(frozen=True)
class Header:
    """A header that was written: its path, size in bytes, and the SHA-256 of the file."""

    path: Path
    bytes: int
    sha256: str


def write_header(
    path: str | Path,
    bsdf: DualScattering,
    proposal: AmortisedProposal,
    *,
    namespace: str = "hair",
    facts: Mapping[str, Any] | None = None,
) -> Header:
    """Write a BSDF and its proposal as one C++17 header without dependencies.

    The header prepares contexts, evaluates F cos(theta_i), and draws directions with their density, by unit vectors or
    angles, in float32. Equal input gives equal bytes.

    Args:
        path: of the file, which is either written whole or not at all.
        bsdf: a round `marschner` fibre in a convention that `HairKernel` serves.
        proposal: an `AmortisedProposal` of this BSDF, trained or not.
        namespace: C++ namespace of everything in it.
        facts: what the comment says of the training, such as `{"steps": 2400, "seed": 0}`.

    Raises:
        InputError: what a header cannot hold (`check_exported`), or no C++ name.
    """
    content = header(bsdf, proposal, namespace=namespace, facts=facts).encode()
    write_bytes(path, content)
    return Header(Path(path), len(content), hashlib.sha256(content).hexdigest())


def header(
    bsdf: DualScattering,
    proposal: AmortisedProposal,
    *,
    namespace: str = "hair",
    facts: Mapping[str, Any] | None = None,
) -> str:
    """The text that `write_header` writes."""
    check_namespace(namespace)
    tables = make_tables(bsdf, proposal)
    return header_text(tables, namespace, _comment(bsdf, proposal, facts or {}), known_albedos(bsdf))


def write_example(path: str | Path, header: str | Path, namespace: str = "hair") -> None:
    """Write the program that integrates a header's sampler to the known albedos.

    Raises:
        InputError: `namespace` is no C++ name, or the header's name cannot be included.
    """
    name = Path(header).name
    if any(c in name for c in '"\\\n'):
        raise InputError("header", name, "a file name without quotes, backslashes and line ends")
    text = source("example.cpp").replace('"hair.h"', f'"{name}"').replace("hair::", f"{check_namespace(namespace)}::")
    write_bytes(path, text.encode())


def known_albedos(bsdf: DualScattering) -> list[tuple[float, ...]]:
    """theta_r, n, v of `KNOWN` and the integral of F cos(theta_i) of each, by channel."""
    rows = torch.tensor(KNOWN, dtype=torch.float32).double()  # as the header will have them
    found = reference(Integrand(bsdf), Context(rows[:, 0], 0.0, rows[:, 1], rows[:, 2]), _RTOL)
    return [(*row, *albedo) for row, albedo in zip(rows.tolist(), found.value.tolist(), strict=True)]


def _comment(bsdf: DualScattering, proposal: AmortisedProposal, facts: Mapping[str, Any]) -> list[str]:
    """What the header is made of."""
    network = proposal.network
    sizes = [network.weights[0].shape[1], *(len(bias) for bias in network.biases)]
    trained = any(bool((w != 0).any()) for w in (network.weights[-1], network.biases[-1]))
    lines = [
        f"Dual scattering hair BSDF and a sampler fitted to it, written by dsfit {code_version()}.",
        "",
        "Fibre (absorption per fibre radius; angles in degrees, lobes R, TT, TRT):",
    ]
    for name, value in bsdf.fiber.parameters().items():
        numbers = value.detach().double().flatten()
        numbers = numbers * (180 / math.pi) if name in _DEGREES else numbers
        lines.append(f"  {name} = {', '.join(f'{x:.9g}' for x in numbers.tolist())}")
    lines += [
        f"Density factors d_f = {float(bsdf.d_f):.9g}, d_b = {float(bsdf.d_b):.9g}. Convention: {_convention(bsdf)}.",
        f"Proposal: {len(proposal.names)} lobes, uniform share {proposal.defensive:.9g}, network {sizes}, "
        + ("trained." if trained else "not trained: the closed-form start."),
    ]
    lines += [f"  {name}: {value}" for name, value in facts.items()]
    lines.append(f"SHA-256 of the proposal: {_digest(proposal)}")
    return lines


def _convention(bsdf: DualScattering) -> str:
    own = bsdf.convention
    changed = [f.name for f in fields(Convention) if getattr(own, f.name) != getattr(CONSISTENT, f.name)]
    return "consistent" + "".join(f", {name} = {getattr(own, name)}" for name in changed)


def _digest(proposal: AmortisedProposal) -> str:
    """Of all parameters and tables, in float64."""
    digest = hashlib.sha256()
    for name, value in sorted(proposal.state_dict().items()):
        digest.update(f"{name} {tuple(value.shape)}\0".encode() + value.double().numpy().astype(np.float64).tobytes())
    return digest.hexdigest()
