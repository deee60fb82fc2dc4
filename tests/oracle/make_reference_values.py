"""Writes reference_values.json beside this file: the oracle at many points of seven fibres. Deterministic.

    python tests/oracle/make_reference_values.py             # about a minute on one core
    python tests/oracle/make_reference_values.py --verify    # compares every stored value with another method

Inputs are float32 numbers (stored exactly), so that a float32 implementation sees the same points. Random points keep
at least 1e-4 rad (`margin`) from the caustics and support edges of the raw lobes, where N_p is singular or zero, and
1 % from the pole 1 - a_f = 0 of the printed averages. All arrays are [lobe][channel] or [channel]. Per point:

    theta_i theta_r phi n v phi_h theta_diff margin
    azimuthal, scattered   {model: N_p or N^G_p at (theta_diff, phi, phi_h)}, models marschner, raw, simplified
    mean                   E_p / (2 pi), the size of N_p and N^G_p (marschner: that of raw)
    averages               at theta_in = theta_i, consistent;  averages_printed at theta_in = theta_diff
    consistent             {model: F cos(theta_i)}
    peak                   F cos(theta_i), marschner, with all longitudinal Gaussians at their maximum
    printed                {model: f of eqs (4)-(12)} for marschner and simplified
`switches` lists averages under single changed switches of the convention.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from dataclasses import asdict, replace
from pathlib import Path

import mpmath
import numpy as np

sys.path.insert(0, str(Path(__file__).parent))

import oracle_azimuth as oz  # noqa: E402
import oracle_bsdf as ob  # noqa: E402
import oracle_scattered as og  # noqa: E402
from oracle_averages import Averages, Options, averages  # noqa: E402
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

SWITCHES = {
    "outgoing": Options(cosine="outgoing"),
    "half": Options(split="half"),
    "mean": Options(width="mean"),
    "absorption": Options(absorption="printed"),
    "plus": Options(delta_sign=1.0),
    "energy": Options(c_m=1.0),
    "printed": ob.PRINTED,
}


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


def fields(a: Averages) -> dict[str, np.ndarray]:
    return {name: getattr(a, name) for name in Averages.FIELDS}


def evaluate(fiber: Fiber, point: dict[str, float], order: int = 16) -> dict:
    g = ob.Geometry(point["theta_i"], point["theta_r"], point["phi"], point["phi_h"])
    n, v, t = point["n"], point["v"], g.theta_diff
    lobes = range(3)
    return {
        "azimuthal": {m: np.array([oz.azimuthal(fiber, p, t, g.phi, m, g.phi_h) for p in lobes]) for m in oz.MODELS},
        "scattered": {m: np.array([og.scattered(fiber, p, t, g.phi, m, g.phi_h) for p in lobes]) for m in oz.MODELS},
        "mean": np.array([oz.energy(fiber, p, t, oz.lobe_eta(fiber, p, g.phi_h)) for p in lobes]) / oz.TWO_PI,
        "averages": fields(averages(fiber, g.theta_i, order=order)),
        "averages_printed": fields(averages(fiber, t, options=ob.PRINTED, order=order)),
        "consistent": {m: ob.consistent(fiber, g, n, v, m, order=order) for m in oz.MODELS},
        "peak": ob.peak(fiber, g, n, v),
        "printed": {m: ob.printed(fiber, g, n, m, order=order) for m in ("marschner", "simplified")},
    }


def switches(order: int = 16) -> list[dict]:
    rows = []
    for name in ("blond", "brown", "dense"):
        for theta_in in map(as_float32, (-0.7, 0.2, 1.3)):
            for switch, options in SWITCHES.items():
                a = averages(FIBERS[name], theta_in, options=options, order=order)
                rows.append({"fiber": name, "theta_in": theta_in, "switch": switch, "averages": fields(a)})
    return rows


def plain(x):
    """JSON-ready copy; floats rounded to 16 significant digits (relative error below 5e-16)."""
    if isinstance(x, dict):
        return {key: plain(value) for key, value in x.items()}
    if isinstance(x, (list, tuple)):
        return [plain(value) for value in x]
    if isinstance(x, np.ndarray):
        return plain(x.tolist())
    return float(f"{x:.{DIGITS}g}") if isinstance(x, float) else x


# --------------------------------------------------------------------------------------------------------- verification


def azimuthal_30_digits(fiber: Fiber, p: int, theta_diff: float, phi: float, model: str, phi_h: float) -> list[float]:
    """N_p (marschner, raw) in 30-digit arithmetic; the oracle gives only the number and rough place of the roots."""
    mp = mpmath
    with mp.workdps(30):
        eta, t = mp.mpf(fiber.eta), mp.mpf(theta_diff)
        if p == 2:
            a2 = mp.mpf(fiber.eccentricity) ** 2
            one, two = 2 * (eta - 1) * a2 - eta + 2, 2 * (eta - 1) / a2 - eta + 2
            eta = (one + two + mp.cos(2 * mp.mpf(phi_h)) * (one - two)) / 2
        e1 = mp.sqrt(eta**2 - mp.sin(t) ** 2) / mp.cos(t)

        def azimuth(gi):
            return 2 * p * mp.asin(mp.sin(gi) / e1) - 2 * gi + p * mp.pi

        def path(gi, sigma):
            c = mp.cos(t) * mp.cos(gi)
            c_t = mp.sqrt(1 - (1 - c * c) / eta**2)
            f = (((c - eta * c_t) / (c + eta * c_t)) ** 2 + ((eta * c - c_t) / (eta * c + c_t)) ** 2) / 2
            length = 2 * p * mp.sqrt(1 - (mp.sin(gi) / e1) ** 2) / mp.sqrt(1 - (mp.sin(t) / eta) ** 2)
            return f if p == 0 else (1 - f) ** 2 * f ** (p - 1) * mp.exp(-sigma * length)

        def gap(x):
            return x - 2 * mp.pi * mp.nint(x / (2 * mp.pi))

        totals = []
        for sigma in map(mp.mpf, fiber.sigma_a):
            total = mp.mpf(0)
            for start in oz.roots(p, phi, oz.bravais(oz.lobe_eta(fiber, p, phi_h), theta_diff)[0]):
                if abs(abs(start) - oz.HALF_PI) < 1e-9:
                    continue
                gi = mp.findroot(lambda x: gap(azimuth(x) - phi), mp.mpf(start))
                slope = 2 * p * mp.cos(gi) / mp.sqrt(e1**2 - mp.sin(gi) ** 2) - 2
                total += path(gi, sigma) * mp.cos(gi) / abs(slope) / 2
            if p == 2 and model == "marschner":
                w = mp.mpf(fiber.caustic_width)
                if e1 < 2:
                    h = mp.sqrt((4 - e1**2) / 3)
                    curve = mp.diff(lambda x: azimuth(mp.asin(x)), h, 2)
                    offset = min(mp.mpf(fiber.caustic_max_offset), 2 * mp.sqrt(2 * w / abs(curve)))
                    keep = mp.mpf(1)
                else:
                    h, offset = mp.mpf(0), mp.mpf(fiber.caustic_max_offset)
                    s = min((e1 - 2) / mp.mpf(fiber.caustic_fade), mp.mpf(1))
                    keep = 1 - s * s * (3 - 2 * s)
                centre = gap(azimuth(mp.asin(h))) if e1 < 2 else mp.mpf(0)
                height = keep * mp.mpf(fiber.glint_scale) * path(mp.asin(h), sigma) * offset
                for c in (centre, -centre):
                    total *= 1 - keep * mp.exp(-(gap(phi - c) ** 2) / (2 * w * w))
                for c in (centre, -centre):
                    total += height * mp.npdf(gap(phi - c), 0, w)
            totals.append(float(total))
        return totals


def deviation(x: np.ndarray, y: np.ndarray, floor: np.ndarray | float = 0.0) -> float:
    size = np.maximum(np.abs(y), floor)
    return float(np.max(np.where(size > 0.0, np.abs(x - y) / np.where(size > 0.0, size, 1.0), np.abs(x - y))))


def verify(data: dict) -> None:
    """Prints the largest relative deviations from other methods (N and N^G: relative to max(value, 1e-3 mean))."""
    for name, fiber in FIBERS.items():
        worst = dict.fromkeys(
            ("azimuthal", "scattered", "scattered_raw", "averages", "averages_printed", "consistent", "printed"), 0.0
        )
        for point in data["fibers"][name]["points"]:
            t, phi, phi_h = point["theta_diff"], point["phi"], point["phi_h"]
            floor = 1e-3 * np.array(point["mean"])
            for model in ("marschner", "raw"):
                for p in range(3):
                    other = np.array(azimuthal_30_digits(fiber, p, t, phi, model, phi_h))
                    worst["azimuthal"] = max(
                        worst["azimuthal"], deviation(np.array(point["azimuthal"][model][p]), other, floor[p])
                    )
                    method = og.scattered_by_azimuth if model == "raw" else og.scattered_by_offset
                    other = method(fiber, p, t, phi, model, phi_h)
                    key = "scattered_raw" if model == "raw" else "scattered"
                    worst[key] = max(worst[key], deviation(np.array(point["scattered"][model][p]), other, floor[p]))
            finer = evaluate(fiber, point, order=20)
            for key in ("averages", "averages_printed", "consistent", "printed"):
                for inner, value in finer[key].items():
                    angle = inner in ("alpha_f", "alpha_b", "delta_b")
                    size = max(np.abs(value).max(), abs(fiber.alpha[0])) if angle else 0.0
                    worst[key] = max(worst[key], deviation(np.array(point[key][inner]), value, size))
        print(name, {key: f"{value:.1e}" for key, value in worst.items()}, flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--verify", action="store_true", help="check the stored values by other methods; writes nothing"
    )
    if parser.parse_args().verify:
        verify(json.loads(OUTPUT.read_text()))
        return
    data: dict = {"d_f": 0.7, "d_b": 0.7, "fibers": {}}
    for seed, (name, fiber) in enumerate(FIBERS.items()):
        rows = [{**point, **evaluate(fiber, point)} for point in points(fiber, seed)]
        data["fibers"][name] = {"parameters": asdict(replace(fiber)), "points": rows}
        print(f"{name}: {len(rows)} points", flush=True)
    data["switches"] = switches()
    OUTPUT.write_text(json.dumps(plain(data), separators=(",", ":")).replace('{"theta_i"', '\n{"theta_i"') + "\n")


if __name__ == "__main__":
    main()
