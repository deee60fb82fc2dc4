"""Writes reference_values.json beside this file: the oracle at many points of seven fibres. Deterministic.

    python tests/oracle/make_reference_values.py       # about two minutes on one core
    python tests/oracle/verify_reference_values.py     # compares every stored value with another method

Inputs are float32 numbers (stored exactly), so that a float32 implementation sees the same points. Random points keep
at least 1e-4 rad (`margin`) from the caustics and support edges of the raw lobes, where N_p is singular or zero, and
1 % from the pole 1 - a_f = 0 of the printed averages. All arrays are [lobe][channel] or [channel]. Per point:

    theta_i theta_r phi n v phi_h theta_diff margin
    azimuthal, scattered   {model: N_p or N^G_p at (theta_diff, phi, phi_h)}, models marschner, raw, simplified
    size_azimuthal, size_scattered   the largest N_p and N^G_p (marschner) on a grid of phi
    averages               at theta_in = theta_i, consistent;  averages_printed at theta_in = theta_diff
    consistent             {model: F cos(theta_i)}
    printed                {model: f of eqs (4)-(12)} for marschner and simplified
    size, size_printed     {model: the sum of |terms| with all longitudinal Gaussians at their maximum}
`switches` lists averages and F (marschner and simplified) with one switch of `consistent` changed at a time.
"""

from __future__ import annotations

import json
import math
import sys
from dataclasses import asdict
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parent))

import oracle_azimuth as oz  # noqa: E402
import oracle_bsdf as ob  # noqa: E402
import oracle_scattered as og  # noqa: E402
from oracle_averages import Averages, averages  # noqa: E402
from oracle_azimuth import Fiber  # noqa: E402

RAD = math.radians
POINTS = 36
OUTPUT = Path(__file__).with_name("reference_values.json")
DIGITS = 16

FIBERS = {
    "nonabsorbing": Fiber((0.0, 0.0, 0.0)),
    "blond": Fiber((0.03, 0.07, 0.15)),
    "brown": Fiber((0.432, 0.612, 0.98)),
    "black": Fiber((3.35, 5.58, 10.96)),
    "elliptic": Fiber((0.05, 0.3, 1.2), eta=1.3, eccentricity=0.9),
    "dense": Fiber((0.02, 0.2, 2.0), eta=2.2),
    "narrow": Fiber(
        (0.0, 0.1, 0.5),
        alpha=(RAD(-3.0), RAD(1.5), RAD(4.5)),
        beta=(RAD(0.5), RAD(0.5), RAD(0.5)),
        caustic_width=RAD(3.0),
        gamma_tt=RAD(12.0),
    ),
}

# (theta_i, theta_r, phi, n, v): normal, specular, retro, grazing, the caustic's fade, no fibre and very many in front.
STRUCTURED = [
    (0.0, 0.0, 0.0, 0.0, 1.0),
    (0.0, 0.0, 3.1415925, 0.0, 1.0),
    (0.7, -0.7, 3.0, 1.0, 0.0),
    (0.7, -0.6, 0.2, 2.0, 0.25),
    (1.4, 1.4, -0.5, 3.0, 0.0),
    (1.5, -1.5, 2.5, 5.0, 0.5),
    (-1.5, 1.45, -3.0, 20.0, 0.0),
    (1.55, -0.2, 1.0, 2.5, 0.0),
    (-0.3, 0.5, 1.5707963, 1000.0, 0.0),
    (0.2, 0.3, -1.3, 0.0, 0.0),
    (-0.8, 0.85, 0.4, 1.0, 1.0),
    (0.9, -0.9, 0.0, 3.0, 0.0),
]

SWITCHES = [
    {name: value}
    for name, value in asdict(ob.PRINTED_SLIPS).items()
    if value != getattr(ob.Slips(), name) and name != "simplified_energy"
] + [
    {"simplified_energy": "printed"},
    {"back_azimuth": "back"},
    {"shift_sign": "plus"},
    {"absorption": "printed2003"},
    {"split": "half"},
    {"mean_width": "width"},
    {"average_weight": "outgoing"},
]
SWITCH_POINTS = [(-0.7, 0.55, 2.6, 3.0, 0.25), (0.2, 0.1, 0.5, 1.0, 0.5), (1.3, -1.0, -1.9, 6.0, 0.0)]


def as_float32(x: float) -> float:
    return float(np.float32(x))


def margin(fiber: Fiber, theta_diff: float, phi: float, phi_h: float) -> float:
    """Distance of phi from the nearest caustic or support edge of any raw lobe, modulo 2 pi."""
    worst = math.pi
    for p in (1, 2):
        eta1 = oz.bravais(oz.lobe_eta(fiber, p, phi_h), theta_diff)[0]
        for edge in og.singular_azimuths(p, eta1):
            if math.pi - abs(edge) > 1e-12:
                worst = min(worst, abs(oz.wrap(phi - edge)))
    return worst


def random_point(fiber: Fiber, rng: np.random.Generator) -> tuple[float, ...]:
    """Half of the points near the peak of a lobe, half anywhere."""
    theta_r = rng.uniform(-1.5, 1.5)
    theta_i = rng.uniform(-1.55, 1.55)
    if rng.random() < 0.5:
        p = rng.integers(3)
        theta_i = 2 * (fiber.alpha[p] + rng.uniform(-3, 3) * fiber.beta[p]) - theta_r
    n = [0.0, 1.0, float(rng.integers(2, 12)), math.exp(rng.uniform(0, 4.6))][rng.integers(4)]
    v = [0.0, 0.0, 1.0, rng.uniform()][rng.integers(4)]
    return theta_i, theta_r, rng.uniform(-math.pi, math.pi), n, v


def points(fiber: Fiber, seed: int) -> list[dict[str, float]]:
    rng, chosen = np.random.default_rng(seed), []
    candidates = list(STRUCTURED)
    while len(chosen) < POINTS:
        theta_i, theta_r, phi, n, v = map(as_float32, candidates.pop(0) if candidates else random_point(fiber, rng))
        phi_h = as_float32(rng.uniform(-math.pi, math.pi)) if fiber.eccentricity != 1.0 else 0.0
        theta_diff = 0.5 * (theta_r - theta_i)
        space = margin(fiber, theta_diff, phi, phi_h)
        if abs(theta_i) > 1.56 or space < 1e-4:
            continue
        if np.abs(1.0 - averages(fiber, theta_diff, options=ob.PRINTED).a_f).min() < 0.01:
            continue
        names = ("theta_i", "theta_r", "phi", "n", "v", "phi_h", "theta_diff", "margin")
        chosen.append(dict(zip(names, (theta_i, theta_r, phi, n, v, phi_h, theta_diff, space), strict=True)))
    return chosen


def parameters(fiber: Fiber) -> dict:
    """The fields of dsfit.Fiber."""
    return {name: value for name, value in asdict(fiber).items() if name != "absorption"}


def fields(a: Averages) -> dict[str, np.ndarray]:
    return {name: getattr(a, name) for name in Averages.FIELDS}


def largest(function, fiber: Fiber, p: int, theta_diff: float, phi_h: float, count: int) -> np.ndarray:
    """Largest value per channel over a grid of phi in [0, pi]."""
    return np.max(
        [function(fiber, p, theta_diff, phi, "marschner", phi_h) for phi in np.linspace(0, math.pi, count)], 0
    )


def evaluate(fiber: Fiber, point: dict[str, float], order: int = 16) -> dict:
    g = ob.Geometry(point["theta_i"], point["theta_r"], point["phi"], point["phi_h"])
    n, v, t = point["n"], point["v"], g.theta_diff
    lobes = range(3)
    return {
        "azimuthal": {m: np.array([oz.azimuthal(fiber, p, t, g.phi, m, g.phi_h) for p in lobes]) for m in oz.MODELS},
        "scattered": {m: np.array([og.scattered(fiber, p, t, g.phi, m, g.phi_h) for p in lobes]) for m in oz.MODELS},
        "size_azimuthal": np.array([largest(oz.azimuthal, fiber, p, t, g.phi_h, 33) for p in lobes]),
        "size_scattered": np.array([largest(og.scattered, fiber, p, t, g.phi_h, 5) for p in lobes]),
        "averages": fields(averages(fiber, g.theta_i, order=order)),
        "averages_printed": fields(averages(fiber, t, options=ob.PRINTED, order=order)),
        "consistent": {m: ob.consistent(fiber, g, n, v, m, order=order) for m in oz.MODELS},
        "size": {m: ob.general(fiber, g, n, v, m, order=order)[1] for m in oz.MODELS},
        "printed": {m: ob.printed(fiber, g, n, m, order=order) for m in ("marschner", "simplified")},
        "size_printed": {
            m: ob.general(fiber, g, n, v, m, slips=ob.PRINTED_SLIPS, order=order)[1]
            for m in ("marschner", "simplified")
        },
    }


def switches(order: int = 16) -> list[dict]:
    rows = []
    for name in ("blond", "dense"):
        for raw in SWITCH_POINTS:
            theta_i, theta_r, phi, n, v = map(as_float32, raw)
            g = ob.Geometry(theta_i, theta_r, phi)
            for switch in SWITCHES:
                slips = ob.Slips(**switch)
                row = {
                    "fiber": name,
                    "theta_i": theta_i,
                    "theta_r": theta_r,
                    "phi": phi,
                    "n": n,
                    "v": v,
                    "switch": switch,
                }
                row["averages"] = fields(
                    averages(slips.fiber(FIBERS[name]), theta_i, options=slips.options(), order=order)
                )
                for model in ("marschner", "simplified"):
                    row[model], row[model + "_size"] = ob.general(
                        FIBERS[name], g, n, v, model, slips=slips, order=order
                    )
                rows.append(row)
    return rows


def plain(x, digits: int = DIGITS):
    """JSON-ready copy; floats rounded to 16 significant digits (relative error below 5e-16), sizes to 3."""
    if isinstance(x, dict):
        return {key: plain(value, 3 if "size" in key else digits) for key, value in x.items()}
    if isinstance(x, (list, tuple)):
        return [plain(value, digits) for value in x]
    if isinstance(x, np.ndarray):
        return plain(x.tolist(), digits)
    return float(f"{x:.{digits}g}") if isinstance(x, float) else x


def main() -> None:
    data: dict = {"d_f": 0.7, "d_b": 0.7, "fibers": {}}
    for seed, (name, fiber) in enumerate(FIBERS.items()):
        rows = [{**point, **evaluate(fiber, point)} for point in points(fiber, seed)]
        data["fibers"][name] = {"parameters": parameters(fiber), "points": rows}
        print(f"{name}: {len(rows)} points", flush=True)
    data["switches"] = switches()
    text = json.dumps(plain(data), separators=(",", ":"))
    OUTPUT.write_text(text.replace('{"theta_i"', '\n{"theta_i"').replace('{"fiber"', '\n{"fiber"') + "\n")


if __name__ == "__main__":
    main()
