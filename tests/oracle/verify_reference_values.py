"""Compares reference_values.json with other methods and prints the largest relative deviations per fibre.

    python tests/oracle/verify_reference_values.py     # about three minutes on one core

N_p: 30-digit arithmetic. N^G: the method that did not make the stored value (raw: quadrature over phi across inverse
square roots, good to 1e-10 only). Averages and F: higher quadrature order. All but scattered_raw come out below 1e-11.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import mpmath
import numpy as np

sys.path.insert(0, str(Path(__file__).parent))

import oracle_azimuth as oz  # noqa: E402
import oracle_scattered as og  # noqa: E402
from make_reference_values import FIBERS, OUTPUT, evaluate  # noqa: E402
from oracle_azimuth import Fiber  # noqa: E402


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
    """Prints the largest relative deviations from other methods (N and N^G: relative to max(value, 1e-3 size))."""
    for name, fiber in FIBERS.items():
        worst = dict.fromkeys(
            ("azimuthal", "scattered", "scattered_raw", "averages", "averages_printed", "consistent", "printed"), 0.0
        )
        for point in data["fibers"][name]["points"]:
            t, phi, phi_h = point["theta_diff"], point["phi"], point["phi_h"]
            floor = 1e-3 * np.array(point["size_scattered"])
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


if __name__ == "__main__":
    verify(json.loads(OUTPUT.read_text()))
