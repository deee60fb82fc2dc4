"""What a kernel computes, fixed when it is built, and the order of the numbers it reads."""

from __future__ import annotations

from dataclasses import dataclass

NEEDS = ("both", "direct", "scattered")
BLOCK = 16
"""Directions that are computed at once: functions get at least as many."""
GUIDE = 128
"""Equal steps of the CDF in the guides that bracket a column; a power of 2, so that steps are told exactly."""
LOBES = ("R", "TT", "TRT")
FIELDS = ("mode", "below", "above", "log_scale", "edge", "left", "far_left", "near_left", "far_right", "near_right")
"""Per component of the mixture, each `[K, B]`.

    mode                 of theta_h, radians
    below, above         sqrt(1/2) / s on either side of the mode
    log_scale            log of weight x 1/2 (theta_h to theta_i) x 1/2 (both signs of phi) over the mass under the peak
    edge                 sum of the weights up to and including this component
    left                 share of the piece below the mode
    far_*, near_*        2 Q at the far and at the near end of each piece, Q the upper tail of the normal law
"""


@dataclass(frozen=True)
class Layout:
    """Static facts of a kernel; kernels of the same layout share compiled code.

    Attributes:
        channels: channels that are computed.
        direct, scattered: terms of F_direct and F_scatter, among R, TT, TRT, back.
        half_back: whether back scattering stays in |phi| < pi/2.
        poisson: whether the number of fibres that light meets is Poisson distributed (`dsfit.bsdf.forward`).
        components: numbers of the proposal's components in the mixture.
        back_lobe: whether the proposal has a lobe of back scattering.
        laws: per component of the mixture its law of azimuth: the number of a table, "all" or "back" (uniform).
        rows, columns: nodes of the record grid. Each record holds the tabulated densities of azimuth, N_TRT, N^G_R,
            N^G_TT and N^G_TRT, as far as they are needed.
        law_rows, law_columns: nodes of the grid of the laws of azimuth.
        knots: rows of the table of averages.
    """

    channels: int
    direct: tuple[str, ...]
    scattered: tuple[str, ...]
    half_back: bool
    poisson: bool
    components: tuple[int, ...]
    back_lobe: bool
    laws: tuple[int | str, ...]
    rows: int
    columns: int
    law_rows: int
    law_columns: int
    knots: int

    def tabulated(self) -> tuple[str, ...]:
        """Names of the azimuths in a record after the laws."""
        names = ["TRT"] if "TRT" in self.direct else []
        return (*names, *(f"{p}_scattered" for p in LOBES if p in self.scattered))

    def offsets(self) -> dict[str, int]:
        """Where each azimuth starts in a record; the laws come first."""
        position, found = self.tables, {}
        for name in self.tabulated():
            found[name] = position
            position += 1 if name == "R_scattered" else self.channels
        return found

    @property
    def tables(self) -> int:
        """Number of tabulated laws; components may share one."""
        return len({law for law in self.laws if isinstance(law, int)})

    @property
    def width(self) -> int:
        """Numbers per record, filled up to half a cache line or whole ones."""
        sizes = [1 if name == "R_scattered" else self.channels for name in self.tabulated()]
        used = self.tables + sum(sizes)
        return 8 if used <= 8 else -(-used // 16) * 16
