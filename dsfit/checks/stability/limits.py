"""What errors are accepted, and why more than rounding in some classes of regimes.

The limits in the entries are about five times what was measured. Where they are far above rounding:

wide        A law much wider than its domain is flat, and its derivatives, which vanish, are differences of numbers that
            are up to the square of the width over the domain larger.
tail        A law that reaches its domain only with its tail falls by a factor e within std^2 / distance of the domain's
            end; the end is theta_r / 2 +- pi / 4, rounded. A sample there sticks to the end, so that its derivatives in
            the law's parameters are small differences of numbers near 1.
grazing     Both of these to a lesser degree; and azimuths, which poles do not have.
narrow      Where the lobe is 1e-4 to 1e-5 radians wide, angles themselves, sums of angles and the numbers pi / 2 and
            pi / 4 are rounded to a part of the width; in float32 to a large one.
small       Derivatives in parameters of which a small window hardly depends.
ends of u   Samples stick to the end of the domain: as for tail.
caustic     Derivatives that vanish at the seam, where a difference from 2 pi is formed; and cosines that vanish.
switch      A law of width 0.045 has derivatives of 1e-42 beside others of 1.

Turning back thousands of turns costs as many roundings of 2 pi (`frame.wrap`), and next to a log density of 1e6 the log
of a mixture's weight is rounded away in part (`mixture.log_density`).
"""

from __future__ import annotations

Limits = dict[str, tuple[float, float]]


def within(value64: float, gradient64: float, value32: float, gradient32: float) -> Limits:
    """Largest relative errors of value and gradient in float64 and in float32."""
    return {"float64": (value64, gradient64), "float32": (value32, gradient32)}


FEW_ULPS = within(2e-15, 1e-14, 2e-6, 1e-5)
