"""Twins of the optics of a fibre and of its azimuthal lobes, in mpmath at whatever precision it is set to.

Written from the physics, not from the library: Fresnel by Bravais' two effective indices in the normal plane, exit
azimuths by Snell's law at both faces, every ray that leaves at an azimuth by bracketing the exit azimuth between its
turning points, the turning points by bracketing its slope. Where the library uses closed forms or a reduced range by
symmetry, nothing of the kind is used here. Angles in radians; p counts internal segments: 0 = R, 1 = TT, 2 = TRT.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from mpmath import mp

Real = Any
"""An mpmath number (or a float, taken as it is)."""


@dataclass(frozen=True)
class Hair:
    """A fibre of one channel, named as the fields of `dsfit.Fiber`; phi_h is where an elliptic section is seen from."""

    eta: Real
    sigma_a: Real = 0
    eccentricity: Real = 1
    phi_h: Real = 0
    caustic_width: Real = 0.25
    glint_scale: Real = 0.8
    caustic_fade: Real = 0.3
    caustic_max_offset: Real = 0.5
    gamma_tt: Real = 0.5

    def index(self, p: int) -> Real:
        """Index that lobe p sees: that of TRT turns with an elliptic section (Marschner et al. 2003, 5.2.3)."""
        if p < 2:
            return mp.mpf(self.eta)
        a2 = mp.mpf(self.eccentricity) ** 2
        major, minor = (2 * (mp.mpf(self.eta) - 1) * x - self.eta + 2 for x in (a2, 1 / a2))
        return (major + minor + mp.cos(2 * mp.mpf(self.phi_h)) * (major - minor)) / 2


def wrap(angle: Real) -> Real:
    """The angle modulo 2 pi, in [-pi, pi]."""
    return angle - 2 * mp.pi * mp.nint(angle / (2 * mp.pi))


def effective_index(eta: Real, theta_diff: Real) -> Real:
    """Bravais: eta' = sqrt(eta^2 - sin^2 theta_diff) / cos theta_diff."""
    eta, theta_diff = mp.mpf(eta), mp.mpf(theta_diff)
    return mp.sqrt(eta**2 - mp.sin(theta_diff) ** 2) / abs(mp.cos(theta_diff))


@dataclass(frozen=True)
class Section:
    """The normal section of a fibre for one inclination: Bravais' two indices and the absorption along the inclined
    ray.
    """

    first: Real
    second: Real
    absorbed: Real

    @staticmethod
    def at(eta: Real, sigma_a: Real, theta_diff: Real) -> Section:
        """s light sees eta', p light eta'' = eta^2 / eta'; the path is longer by 1 / cos(theta_t)."""
        first = effective_index(eta, theta_diff)
        inclined = mp.mpf(sigma_a) / mp.sqrt(1 - (mp.sin(theta_diff) / mp.mpf(eta)) ** 2)
        return Section(first, mp.mpf(eta) ** 2 / first, inclined)

    def reflectance(self, cos_gamma: Real) -> Real:
        """Fresnel in the section: each polarisation with its index, both refracted by eta'."""
        inner = mp.sqrt(self.first**2 - 1 + cos_gamma**2)
        r_s = (cos_gamma - inner) / (cos_gamma + inner)
        r_p = (self.second * cos_gamma - inner / self.first) / (self.second * cos_gamma + inner / self.first)
        return (r_s**2 + r_p**2) / 2

    def attenuation(self, p: int, h: Real, cos_gamma: Real) -> Real:
        """A(p, h): Fresnel at every face and absorption along 2 p cos gamma_t."""
        f = self.reflectance(cos_gamma)
        if p == 0:
            return f
        inside = mp.sqrt(1 - (h / self.first) ** 2) if self.absorbed else mp.mpf(0)
        return (1 - f) ** 2 * f ** (p - 1) * mp.exp(-2 * p * self.absorbed * inside)

    def carried(self, p: int, gamma: Real) -> Real:
        """A(p, sin gamma)."""
        return self.attenuation(p, mp.sin(gamma), mp.cos(gamma))

    def exit(self, p: int, gamma: Real) -> Real:
        """The exit azimuth, not wrapped."""
        return exit_azimuth(p, self.first, gamma)


def attenuation(p: int, eta: Real, sigma_a: Real, theta_diff: Real, h: Real) -> Real:
    """A(p, h) of the ray of offset h."""
    return Section.at(eta, sigma_a, theta_diff).attenuation(p, mp.mpf(h), mp.sqrt((1 - mp.mpf(h)) * (1 + mp.mpf(h))))


def exit_azimuth(p: int, first: Real, gamma: Real) -> Real:
    """phi(p, gamma) = 2 p gamma_t - 2 gamma + p pi, not wrapped, for an effective index."""
    return 2 * p * mp.asin(mp.sin(gamma) / first) - 2 * gamma + p * mp.pi


def exit_slope(p: int, first: Real, gamma: Real) -> Real:
    """d phi / d gamma."""
    return 2 * p * mp.cos(gamma) / mp.sqrt(first**2 - mp.sin(gamma) ** 2) - 2


def bracketed_root(function: Callable[[Real], Real], slope: Callable[[Real], Real], low: Real, high: Real) -> Real:
    """The root of a monotone function with a change of sign on [low, high], by Newton's method kept in the bracket."""
    sign, x, before = mp.sign(function(high)) or -mp.sign(function(low)), (low + high) / 2, mp.inf
    while True:
        value = function(x)
        if value == 0:
            return x
        if value * sign > 0:
            high = x
        else:
            low = x
        rate = slope(x)
        new = x - value / rate if rate else low
        if not low < new < high or abs(value) > before / 2:
            new = (low + high) / 2
        if abs(new - x) <= mp.eps * max(abs(new), mp.eps):
            return new
        x, before = new, abs(value)


def turning_points(p: int, first: Real) -> list[Real]:
    """gamma in (-pi/2, pi/2) where the exit azimuth turns: none, or a pair."""
    if exit_slope(p, first, mp.mpf(0)) <= 0 or p < 2:
        return []
    found = bracketed_root(
        lambda g: exit_slope(p, first, g), lambda g: mp.diff(lambda x: exit_slope(p, first, x), g), mp.mpf(0), mp.pi / 2
    )
    return [-found, found]


def ray_offsets(p: int, first: Real, phi: Real) -> list[Real]:
    """Every gamma whose ray leaves at phi, modulo 2 pi."""
    ends = [-mp.pi / 2, *turning_points(p, first), mp.pi / 2]
    found = []
    for low, high in zip(ends[:-1], ends[1:], strict=True):
        at_low, at_high = exit_azimuth(p, first, low), exit_azimuth(p, first, high)
        lowest, highest = ((x(at_low, at_high) - phi) / (2 * mp.pi) for x in (min, max))
        for turn in range(int(mp.ceil(lowest)), int(mp.floor(highest)) + 1):
            target = phi + 2 * mp.pi * turn
            if (at_low - target) * (at_high - target) < 0:
                found.append(
                    bracketed_root(
                        lambda g, target=target: exit_azimuth(p, first, g) - target,
                        lambda g: exit_slope(p, first, g),
                        low,
                        high,
                    )
                )
    return found


def lobe(p: int, hair: Hair, theta_diff: Real, phi: Real) -> Real:
    """N_p = (1/2) sum over rays of A |dphi/dh|^-1 (Marschner et al. 2003), the caustic left as it is."""
    eta, phi = hair.index(p), wrap(mp.mpf(phi))
    section = Section.at(eta, hair.sigma_a, theta_diff)
    total = mp.mpf(0)
    for gamma in ray_offsets(p, section.first, phi):
        total += section.carried(p, gamma) * mp.cos(gamma) / (2 * abs(exit_slope(p, section.first, gamma)))
    return total


def fresnel(eta: Real, theta_diff: Real, cos_gamma: Real) -> Real:
    """Unpolarised reflectance of the section at incidence gamma."""
    return Section.at(eta, 0, theta_diff).reflectance(mp.mpf(cos_gamma))


@dataclass(frozen=True)
class Glint:
    """The treatment of the caustic at one inclination: where, how strong the removal, and how much light is added."""

    phi: Real
    fade: Real
    width: Real
    height: Real

    @staticmethod
    def of(hair: Hair, theta_diff: Real) -> Glint:
        """Marschner et al. 2003, section 5.2.2, with h_c = sqrt((4 - eta'^2)/3)."""
        eta = hair.index(2)
        first, widest = effective_index(eta, theta_diff), mp.mpf(hair.caustic_max_offset)
        width = mp.mpf(hair.caustic_width)
        if first < 2:
            h = mp.sqrt((4 - first**2) / 3)
            bend = 4 * h / (first**2 - h**2) ** 1.5 - 2 * h / (1 - h**2) ** 1.5
            phi, fade = exit_azimuth(2, first, mp.asin(h)), mp.mpf(1)
            gathered = min(widest, 2 * mp.sqrt(2 * width / abs(bend)))
        else:
            h, phi, gathered = mp.mpf(0), mp.mpf(0), widest
            x = min((first - 2) / mp.mpf(hair.caustic_fade), mp.mpf(1))
            fade = 1 - x * x * (3 - 2 * x)
        height = fade * hair.glint_scale * gathered * attenuation(2, eta, hair.sigma_a, theta_diff, h)
        return Glint(wrap(phi), fade, width, height)

    def kept(self, phi: Real) -> Real:
        """What the removal leaves of the raw lobe at phi."""
        parts = [1 - self.fade * mp.exp(-((wrap(phi + s * self.phi) / self.width) ** 2) / 2) for s in (-1, 1)]
        return parts[0] * parts[1]

    def added(self, phi: Real) -> Real:
        """The two Gaussians at phi."""
        return self.height * sum(normal(wrap(phi + s * self.phi), self.width) for s in (-1, 1))


def normal(x: Real, std: Real) -> Real:
    """The normal density of standard deviation std at x."""
    return mp.exp(-((x / std) ** 2) / 2) / (std * mp.sqrt(2 * mp.pi))


def lobe_treated(hair: Hair, theta_diff: Real, phi: Real) -> Real:
    """N_TRT with its caustic removed and the glints added."""
    glint = Glint.of(hair, theta_diff)
    return lobe(2, hair, theta_diff, phi) * glint.kept(mp.mpf(phi)) + glint.added(mp.mpf(phi))
