"""Half-circle windows of the azimuthal lobes: int N_p over |phi' - phi| < pi/2, as integrals over offsets."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from dsfit.bsdf.attenuation import Absorption, integrate_offsets
from dsfit.bsdf.fiber import Fiber
from dsfit.bsdf.glint import Glint
from dsfit.bsdf.snell import Caustic, Refraction, exit_trt, gamma_tt, root_falling, root_rising
from dsfit.frame import HALF_PI
from dsfit.special import normal_mass

_SERIES = 4
_NARROW = 0.1  # radians of caustic_width below which intervals are cut at the flanks of what the glint removes
_FLANK = 8.0  # standard deviations from a glint to where nothing is removed any more


def offset_windows(
    fiber: Fiber,
    bent: tuple[Refraction, ...],
    phi: Tensor,
    model: str,
    absorption: Absorption,
    lobes: tuple[int, ...] = (0, 1, 2),
) -> Tensor:
    """Window masses of `lobes`, some of R, TT, TRT, at |phi| in [0, pi], `[..., len(lobes), C]`.

    A window of half width pi/2 around phi reaches over both sides of 0 (phi <= pi/2) or of pi. By symmetry its mass is
    a sum of two one-sided masses, both between 0 and psi or both between psi and pi, so that nothing cancels: phi <=
    pi/2: [0, pi/2 - phi] + [0, pi/2 + phi];  phi > pi/2: [phi - pi/2, pi] + [3 pi/2 - phi, pi].
    """
    near = phi <= HALF_PI
    first = torch.where(near, HALF_PI - phi, phi - HALF_PI)  # not abs, whose derivative is 0 at pi/2
    second = torch.where(near, phi + HALF_PI, 3 * HALF_PI - phi)
    psi = torch.stack([first, second], dim=-1)
    wide = tuple(b.map(lambda x: x.unsqueeze(-1)) for b in bent)
    inner = near.unsqueeze(-1)
    sigma_a = fiber.sigma_a.unsqueeze(-2)
    nodes = _node_count(fiber, model)
    masses = (
        lambda: _mass_r(wide[0], sigma_a, psi, inner, absorption, nodes).sum(-2),
        lambda: _mass_tt(wide[1], sigma_a, psi, inner, absorption, nodes).sum(-2),
        lambda: _mass_trt(fiber, bent[2], phi, psi, inner, model, absorption, nodes),
    )
    return torch.stack(torch.broadcast_tensors(*(masses[p]() for p in lobes)), dim=-2)


def _node_count(fiber: Fiber, model: str) -> int:
    """Gauss nodes per interval: the glint's removal factor is the narrowest feature, about sqrt(w_c) wide in gamma;
    where it is narrower than `_NARROW`, intervals are cut at its flanks instead.
    """
    narrow = float(fiber.caustic_width.detach().min()) if model == "marschner" else 1.0
    return 40 if narrow < _NARROW else max(32, math.ceil(14 / math.sqrt(narrow)))


def _mass_r(
    bent: Refraction, sigma_a: Tensor, psi: Tensor, inner: Tensor, absorption: Absorption, nodes: int
) -> Tensor:
    low = torch.where(inner, 0.0, psi / 2)
    high = torch.where(inner, psi / 2, HALF_PI)
    return integrate_offsets(0, bent, sigma_a, low, high, absorption, nodes=nodes)


def _mass_tt(
    bent: Refraction, sigma_a: Tensor, psi: Tensor, inner: Tensor, absorption: Absorption, nodes: int
) -> Tensor:
    """TT leaves at pi for h = 0 and at 2 asin(kappa) for h = 1, so [psi, pi] holds gamma below the root."""
    edge = 2 * torch.asin(bent.kappa)
    lit = psi > edge
    sin_gamma, cos_gamma = gamma_tt(bent.kappa, torch.where(lit, psi, math.pi))
    root = torch.where(lit, torch.atan2(sin_gamma, cos_gamma), HALF_PI)
    low = torch.where(inner, root, 0.0)
    high = torch.where(inner, HALF_PI, root)
    return integrate_offsets(1, bent, sigma_a, low, high, absorption, nodes=nodes)


def _mass_trt(
    fiber: Fiber,
    bent: Refraction,
    phi: Tensor,
    psi: Tensor,
    inner: Tensor,
    model: str,
    absorption: Absorption,
    nodes: int,
) -> Tensor:
    """Offsets whose exit azimuth lies in [0, psi] (or [psi, pi]), both signs of h at once; `[..., C]` summed over the
    two windows.

    On h > 0, f rises to phi_c at gamma_c and falls to the edge; f in [0, psi] for gamma in [0, a] and [b, ...], and by
    symmetry -f in [0, psi] continues to c, where a, b are the two roots of f = psi and c the root of f = -psi.
    """
    wide = bent.map(lambda x: x.unsqueeze(-1))
    kappa, psi = torch.broadcast_tensors(wide.kappa, psi)
    caustic = Caustic.at(kappa)
    a = torch.where(caustic.folded, root_rising(kappa, caustic, psi), 0.0)
    b = root_falling(kappa, caustic, psi)
    c = root_falling(kappa, caustic, -psi)
    glint = None
    if model == "marschner":
        narrow = Caustic.at(bent.kappa)
        glint = Glint.of(fiber, bent, narrow, absorption)
    weight = None if glint is None else _removal(glint, kappa)
    sigma_a = fiber.sigma_a.unsqueeze(-2)
    zero, middle = torch.zeros_like(a), caustic.gamma
    rising, falling = _removal_cuts(glint, kappa, caustic)
    # inner: [0, a] and [b, c];  outer: [a, b] and [c, pi/2], the first split at the fold
    total: Tensor | float = 0.0
    for cuts, low_in, high_in, low_out, high_out in (
        (rising, zero, a, a, middle),
        (falling[:1], b, b, middle, b),
        (falling, b, c, c, zero + HALF_PI),
    ):
        low, high = torch.where(inner, low_in, low_out), torch.where(inner, high_in, high_out)
        ends = [low, *(torch.minimum(torch.maximum(cut, low), high) for cut in cuts), high]
        for start, end in zip(ends[:-1], ends[1:], strict=True):
            total = total + integrate_offsets(2, wide, sigma_a, start, end, absorption, weight, nodes)
    mass = total.sum(-2)
    return mass if glint is None else mass + glint.added_mass(phi)


def _removal_cuts(glint: Glint | None, kappa: Tensor, caustic: Caustic) -> tuple[list[Tensor], list[Tensor]]:
    """Offsets on the rising and on the falling branch where the removal of a narrow glint sets in or ends, increasing;
    none if it is not narrow. Where exactly makes no difference to the sum, so they carry no derivatives.
    """
    if glint is None or float(glint.width.detach().min()) >= _NARROW:
        return [], []
    width = glint.width.detach()
    reach = _FLANK * (width.unsqueeze(-1) if width.ndim else width)
    kappa, fold = kappa.detach(), caustic.detach()
    rising = torch.where(fold.folded, root_rising(kappa, fold, fold.phi - reach), 0.0)
    falling = [root_falling(kappa, fold, phi) for phi in (fold.phi - reach, reach - fold.phi, -fold.phi - reach)]
    return [rising], list(torch.sort(torch.stack(falling), dim=0).values)


def _removal(glint: Glint, kappa: Tensor):  # noqa: ANN202
    """Removal factor at the azimuth of offset gamma; two extra dimensions: the windows and the Gauss nodes."""
    width = glint.width[..., None, None] if glint.width.ndim else glint.width
    wide = Glint(glint.fade[..., None, None], glint.phi[..., None, None], width, glint.strength)

    def weight(gamma: Tensor) -> Tensor:
        return wide.removal(exit_trt(kappa.unsqueeze(-1), gamma))

    return weight


def simplified_windows(fiber: Fiber, phi: Tensor) -> Tensor:
    """Window masses of the unit-integral simplified azimuths in closed form, `[..., 3]`.

    cos(phi/2)/4 gives (1/sqrt 2) cos(phi/2) for |phi| <= pi/2, 1 - (1/sqrt 2) sin(|phi|/2) beyond; the wrapped
    Gaussian a sum of normal masses.
    """
    root2 = math.sqrt(0.5)
    cosine = torch.where(phi <= HALF_PI, root2 * torch.cos(phi / 2), 1 - root2 * torch.sin(phi / 2))
    transmitted = wrapped_window(beyond_pi(phi), fiber.gamma_tt)
    return torch.stack(torch.broadcast_tensors(cosine, transmitted, cosine), dim=-1)


def beyond_pi(phi: Tensor) -> Tensor:
    """phi - pi for phi in [0, pi], to the last digit: pi in two parts, the first of them exact in the dtype."""
    rounded = float(torch.tensor(math.pi, dtype=phi.dtype))
    rest = (math.pi - rounded) + 1.2246467991473532e-16  # pi - float64(pi)
    return (phi - rounded) - rest


def wrapped_window(distance: Tensor, width: Tensor) -> Tensor:
    """Mass of the wrapped normal of standard deviation `width` within pi/2 of `distance`.

    Images for width <= 2, Fourier series beyond: 1/2 + (2/pi) sum_k e^{-k^2 width^2/2} sin(k pi/2) cos(k distance)/k.
    """
    distance, width = torch.broadcast_tensors(distance, width)
    narrow = width <= 2
    safe = torch.where(narrow, width, 1.0)
    images: Tensor | float = 0.0
    for k in range(-_SERIES, _SERIES + 1):
        center = distance + 2 * math.pi * k
        a, b = (center - HALF_PI) / safe, (center + HALF_PI) / safe
        images = images + normal_mass(a, b)
    broad = torch.where(narrow, 2.0, width)
    series: Tensor | float = 0.5
    for k in range(1, 2 * _SERIES, 2):
        sign = 1.0 if k % 4 == 1 else -1.0
        series = series + sign * torch.exp(-0.5 * (k * broad) ** 2) * torch.cos(k * distance) * (2 / (math.pi * k))
    return torch.where(narrow, images, series)

