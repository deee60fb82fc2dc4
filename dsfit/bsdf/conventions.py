"""The two named conventions, and the single switches they are made of."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any, Literal, get_args, get_type_hints

from dsfit.errors import InputError, check_choice


@dataclass(frozen=True)
class Convention:
    """How the slips of the printed equations are read; `Convention.named("consistent" | "printed", **switches)`.

    The defaults are the `consistent` convention.

    Attributes:
        lobe_norm: factor c_M of every longitudinal lobe. "energy" is 1/2 (d theta_i = 2 d theta_h), "printed" is 1
            (eq 12).
        inverse_cos2: whether scattering terms carry 1 / cos^2(theta_diff), and back scattering 1 / (pi
        cos^2(theta_diff));
            the chapter's (6), (7), (9) lost it.
        share: "complement": F = v F_direct + (1 - v) F_scatter; "sum": both added, v ignored, as (4) prints it.
        density_power: how often d_f multiplies the transmitted light: 1, or 2 as (8) with (32).
        back_factor: factor of f_back inside F_scatter: "derived" is 1 (N^G carries 1 / pi), "pi" is eq (8).
        scattered_azimuth: "convolution": N^G(phi) over the window centred on phi; "constant": eq (11), centred on 0.
        back_argument: centre of the back lobe in "theta_h" or, eq (7) literally, in "theta_diff + theta_r".
        back_width: sigma_f^2 widens back scattering in F_scatter alone ("scatter") or everywhere ("always", eq 7).
        back_azimuth: back scattering leaves at "all" azimuths (published pseudo-code) or in the "back" half, |phi| <
            pi/2.
        shift_sign: sign of 2 q^2 in Delta_b: "minus" as published, "plus" as the event average derives it.
        absorption: per internal segment, "geometric" exp(-2 sigma' cos gamma_t) or "printed2003" exp(-4 sigma' cos^2
            gamma_t).
        split: share of forward light: "fraction" |phi| / pi (incident light over a half circle) or "half", |phi| >
            pi/2.
        mean_width: average of beta^2 ("variance") or of beta ("width").
        average_weight: cosine in the averages: "incident" cos(theta_in) (as published) or "outgoing" cos(theta_o).
        average_angle: averages are taken at "theta_in" = theta_i, or at "theta_diff" as the chapter's a_f(theta_d)
            suggests.
        limit_energy: whether a_f and a_b are divided by max(1, a_f + a_b).
        transmittance: what n fibres on the way of the light do (`dsfit.bsdf.forward`): "power", light meets n of them,
            which pass on a_f^n and widen by n beta_f^2; "poisson", it meets n on average, and the scattered share is
            passed on by E[a_f^N | N >= 1].
        simplified_energy: the simplified azimuths (21), (25) carry each lobe's "attenuation" integral, or are
            "printed" bare.

    Example:
        >>> import dsfit
        >>> dsfit.Convention.named("printed").lobe_norm
        'printed'
        >>> dsfit.Convention.named("consistent", share="sum") == dsfit.Convention(share="sum")
        True
    """

    lobe_norm: Literal["energy", "printed"] = "energy"
    inverse_cos2: bool = True
    share: Literal["complement", "sum"] = "complement"
    density_power: Literal[1, 2] = 1
    back_factor: Literal["derived", "pi"] = "derived"
    scattered_azimuth: Literal["convolution", "constant"] = "convolution"
    back_argument: Literal["theta_h", "theta_diff+theta_r"] = "theta_h"
    back_width: Literal["scatter", "always"] = "scatter"
    back_azimuth: Literal["all", "back"] = "all"
    shift_sign: Literal["minus", "plus"] = "minus"
    absorption: Literal["geometric", "printed2003"] = "geometric"
    split: Literal["fraction", "half"] = "fraction"
    mean_width: Literal["variance", "width"] = "variance"
    average_weight: Literal["incident", "outgoing"] = "incident"
    average_angle: Literal["theta_in", "theta_diff"] = "theta_in"
    limit_energy: bool = True
    transmittance: Literal["power", "poisson"] = "power"
    simplified_energy: Literal["attenuation", "printed"] = "attenuation"

    def __post_init__(self) -> None:
        hints = get_type_hints(type(self))
        for field in fields(self):
            allowed, value = get_args(hints[field.name]) or (True, False), getattr(self, field.name)
            if not isinstance(value, str | int) or value not in allowed:
                raise InputError(f"convention.{field.name}", value, "one of " + ", ".join(map(repr, allowed)))

    @property
    def lobe_constant(self) -> float:
        """c_M."""
        return 0.5 if self.lobe_norm == "energy" else 1.0

    @staticmethod
    def named(name: str | Convention = "consistent", **switches: Any) -> Convention:
        """A named convention with single switches replaced.

        Raises:
            InputError: unknown name, unknown switch, or a switch set to a value it does not have.
        """
        if isinstance(name, Convention):
            base = name
        else:
            base = _NAMED[check_choice("convention", name, tuple(_NAMED))]
        known = tuple(field.name for field in fields(Convention))
        for switch in switches:
            check_choice("convention switch", switch, known)
        return replace(base, **switches)


CONSISTENT = Convention()
"""Energy-consistent reading of the model (the default)."""

PRINTED = Convention(
    lobe_norm="printed",
    inverse_cos2=False,
    share="sum",
    density_power=2,
    back_factor="pi",
    scattered_azimuth="constant",
    back_argument="theta_diff+theta_r",
    back_width="always",
    average_angle="theta_diff",
    limit_energy=False,
    simplified_energy="printed",
)
"""The chapter's equations (4)-(12), (32) as printed, as far as they can be evaluated."""

_NAMED = {"consistent": CONSISTENT, "printed": PRINTED}
