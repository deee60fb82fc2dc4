"""Mitsuba 3's `hair` BSDF (Chiang et al. 2016) as contenders: one fibre, no scattering among fibres."""

from __future__ import annotations

import glob
import importlib.metadata
import importlib.util
import os
import re
import subprocess
import sys
from dataclasses import dataclass
from typing import Any

import numpy as np

from experiments._throughput_timing import Contender

LEAST_LLVM = 19
"""Mitsuba 3.9 aborts the process with LLVM 15 and 16, and its documentation asks for newer ones."""

_PLACES = ("/usr/lib/*/libLLVM*.so*", "/usr/lib/llvm-*/lib/libLLVM*.so*", "/usr/lib64/libLLVM*.so*")
_PROBE = """
import drjit as dr, mitsuba as mi
mi.set_variant("llvm_ad_rgb")
x = dr.exp(dr.arange(mi.Float, 64) / 64)
dr.eval(x)
bsdf = mi.load_dict({"type": "hair"})
print("sum", dr.sum(x)[0])
"""


@dataclass(frozen=True)
class Choice:
    """The variant that works here, the LLVM library it takes (None for scalar code), and why in words."""

    variant: str | None
    llvm: str | None
    reason: str


def llvm_version(path: str) -> int | None:
    """Major version of LLVM by the name of its library or of what the name links to."""
    for name in (os.path.basename(path), os.path.realpath(path)):
        found = re.search(r"libLLVM(?:-|\.so\.)(\d+)", name)
        if found:
            return int(found.group(1))
    return None


def llvm_candidates() -> list[str]:
    """Libraries new enough, newest first; what DRJIT_LIBLLVM_PATH names comes before all others."""
    asked = [path for path in [os.environ.get("DRJIT_LIBLLVM_PATH")] if path]
    found = {os.path.realpath(path) for place in _PLACES for path in glob.glob(place)}
    known = {path: llvm_version(path) for path in [*asked, *sorted(found)]}
    good = {path: version for path, version in known.items() if version is not None and version >= LEAST_LLVM}
    return sorted(good, key=lambda path: (path not in asked, -good[path]))


def choose() -> Choice:
    """The fastest variant that works, found out in a process of its own: a wrong library ends it."""
    if importlib.util.find_spec("mitsuba") is None:
        return Choice(None, None, "Mitsuba is not installed")
    candidates = llvm_candidates()
    for path in candidates:
        environment = {**os.environ, "DRJIT_LIBLLVM_PATH": path}
        done = subprocess.run(
            [sys.executable, "-c", _PROBE], env=environment, capture_output=True, text=True, timeout=120, check=False
        )
        if done.returncode == 0 and done.stdout.startswith("sum"):
            return Choice("llvm_ad_rgb", path, f"LLVM {llvm_version(path)}")
    found = f"of {len(candidates)} libraries none works" if candidates else "none is here"
    return Choice("scalar_rgb", None, f"vectorised code needs LLVM {LEAST_LLVM} or newer; {found}: scalar code")


def version() -> str:
    """Version of Mitsuba, empty where it is not installed."""
    try:
        return importlib.metadata.version("mitsuba")
    except importlib.metadata.PackageNotFoundError:
        return ""


def start(choice: Choice, threads: int) -> Any:
    """Load Mitsuba's variant in this process, with that many threads."""
    if choice.llvm is not None:
        os.environ["DRJIT_LIBLLVM_PATH"] = choice.llvm
    import mitsuba as mi

    mi.set_variant(choice.variant)
    if choice.llvm is not None:
        import drjit as dr

        dr.set_thread_count(threads)
    return mi


def contenders(mi: Any, count: int, seed: int = 1) -> list[Contender]:
    """eval, pdf, sample and the three fused, for `count` directions, each with its own view and offset."""
    fiber = {
        "type": "hair",
        "sigma_a": {"type": "rgb", "value": [0.2, 0.5, 1.0]},
        "longitudinal_roughness": 0.1,
        "azimuthal_roughness": 0.3,
        "scale_tilt": 2.0,
        "int_ior": 1.55,
    }
    bsdf = mi.load_dict(fiber)
    random = np.random.default_rng(seed)
    if mi.variant().startswith("scalar"):
        return _scalar(mi, bsdf, count, random)
    return _vectorised(mi, bsdf, count, random)


def _vectorised(mi: Any, bsdf: Any, count: int, random: np.random.Generator) -> list[Contender]:
    """On arrays; `frozen` replays the launch of a kernel that was traced before, the others trace for every call."""
    import drjit as dr

    view, light = (mi.Vector3f(*_sphere(count, random)) for _ in range(2))
    offset, first, second, third = (mi.Float(random.random(count, dtype=np.float32)) for _ in range(4))
    inputs = view, light, offset, first, second, third
    dr.eval(*inputs)
    dr.sync_thread()
    context = mi.BSDFContext()

    def interaction(view: Any, offset: Any) -> Any:
        found = dr.zeros(mi.SurfaceInteraction3f, count)
        found.wi, found.uv = view, mi.Point2f(0.0, offset)
        return found

    def evaluate(view: Any, light: Any, offset: Any, *_: Any) -> Any:
        return bsdf.eval(context, interaction(view, offset), light)

    def density(view: Any, light: Any, offset: Any, *_: Any) -> Any:
        return bsdf.pdf(context, interaction(view, offset), light)

    def sample(view: Any, light: Any, offset: Any, first: Any, second: Any, third: Any) -> Any:
        drawn, weight = bsdf.sample(context, interaction(view, offset), first, mi.Point2f(second, third))
        return drawn.wo, drawn.pdf, weight

    def fused(view: Any, light: Any, offset: Any, first: Any, second: Any, third: Any) -> Any:
        found = interaction(view, offset)
        drawn, _ = bsdf.sample(context, found, first, mi.Point2f(second, third))
        value, density = bsdf.eval_pdf(context, found, drawn.wo)
        return drawn.wo, density, value

    def timed(function: Any) -> Any:
        def run() -> None:
            dr.eval(function(*inputs))
            dr.sync_thread()

        return run

    tasks = {"eval": evaluate, "log_prob": density, "sample": sample, "fused": fused}
    found = [Contender("Mitsuba", task, "all different", count, timed(dr.freeze(f))) for task, f in tasks.items()]
    for task in ("eval", "fused"):
        found.append(Contender("Mitsuba, traced anew", task, "all different", count, timed(tasks[task])))
    return found


def _scalar(mi: Any, bsdf: Any, count: int, random: np.random.Generator) -> list[Contender]:
    """One direction a call, from Python: a few tenths of a microsecond of each are the call itself."""
    context, found = mi.BSDFContext(), mi.SurfaceInteraction3f()
    x, y, z = _sphere(1, random)[:, 0].tolist()
    found.wi, found.uv = mi.Vector3f(x, y, z), mi.Point2f(0.0, 0.3)
    pairs = [mi.Point2f(*map(float, pair)) for pair in random.random((count, 2))]
    lights = [mi.Vector3f(*map(float, column)) for column in _sphere(count, random).T]

    def evaluate() -> None:
        for light in lights:
            bsdf.eval(context, found, light)

    def fused() -> None:
        for pair in pairs:
            drawn, _ = bsdf.sample(context, found, 0.3, pair)
            bsdf.eval_pdf(context, found, drawn.wo)

    runs = {"eval": evaluate, "fused": fused}
    return [Contender("Mitsuba, scalar", task, "one context", count, run) for task, run in runs.items()]


def _sphere(count: int, random: np.random.Generator) -> np.ndarray:
    """Unit vectors, `[3, count]`, uniform over the sphere."""
    z = random.uniform(-1, 1, count)
    angle = random.uniform(0, 2 * np.pi, count)
    radius = np.sqrt(1 - z * z)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), z]).astype(np.float32)
