"""Lights: values against independent formulas, proposals against their densities."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from scipy.interpolate import RegularGridInterpolator
from scipy.special import ive
from scipy.stats import chi2
from torch import Tensor

from dsfit.context import Context
from dsfit.errors import InputError
from dsfit.frame import HALF_PI, to_angles, to_vector
from dsfit.quadrature import gauss_legendre
from dsfit.scene import ConstantLight, EnvironmentLight, Light, VonMisesFisherLights

CONTEXT = Context(0.3, 1.0)
SAMPLES = 150_000
# Takes the map's pole (y) to the fibre's tangent (x).
POLE_TO_TANGENT = torch.tensor([[0.0, 1, 0], [0, 0, 1], [1, 0, 0]], dtype=torch.float64)


def uniforms(count: int, dimension: int, seed: int = 1, dtype: torch.dtype = torch.float64) -> Tensor:
    g = torch.Generator().manual_seed(seed)
    return torch.rand(count, dimension, generator=g, dtype=dtype).clamp(1e-7, 1 - 1e-7)


def rotation(seed: int) -> Tensor:
    q, _ = torch.linalg.qr(torch.randn(3, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64))
    return q * torch.sign(torch.linalg.det(q))


def picture(height: int, width: int, channels: int = 3, seed: int = 0) -> Tensor:
    g = torch.Generator().manual_seed(seed)
    image = torch.rand(height, width, channels, generator=g, dtype=torch.float64) ** 6
    image[:, : width // 4] = 0  # black columns: the density must be zero there and the search must skip them
    image[height // 3, width // 2] = 30.0
    return image


LIGHTS = {
    "constant": lambda: ConstantLight([1.0, 0.5, 0.1]),
    "vmf wide": lambda: VonMisesFisherLights([[0.2, 0.5]], 3.0, [[1.0, 2.0, 3.0]]),
    "vmf kappa 0": lambda: VonMisesFisherLights([[0.2, 0.5]], 0.0, [[1.0, 2.0, 3.0]]),
    "vmf tenth of a degree": lambda: VonMisesFisherLights(
        [[0.4, -2.0]], VonMisesFisherLights.kappa_of_width(math.radians(0.1)), [[1.0, 1.0, 1.0]]
    ),
    "vmf 1e6 at the pole": lambda: VonMisesFisherLights([[1.0, 0.0, 0.0]], 1e6, [[1.0, 2.0, 0.0]]),
    "vmf mixture": lambda: VonMisesFisherLights(
        [[0.3, 1.0], [-1.2, 2.9], [1.5, -3.0], [0.0, 0.0]],
        [1e6, 100.0, 1.0, 1e4],
        [[1.0, 0.2, 0.1], [0.0, 1.0, 0.0], [2.0, 2.0, 2.0], [0.0, 0.0, 0.0]],
        [0.05, 0.1, 0.2],
        rotation=rotation(3),
    ),
    "environment": lambda: EnvironmentLight(picture(8, 16), rotation=POLE_TO_TANGENT),
    "environment oblique": lambda: EnvironmentLight(picture(7, 9), rotation=rotation(5)),
    "environment one row": lambda: EnvironmentLight(picture(1, 12)),
    "environment one texel": lambda: EnvironmentLight(torch.ones(1, 1, 1)),
}
SIDAK = 1 - (1 - 0.01) ** (1 / (2 * len(LIGHTS)))


def cells(light: Light) -> tuple[Tensor, Tensor]:
    """Edges of a grid in (theta, phi) that resolves the light's peaks."""
    thetas, phis = light.breakpoints()
    theta = np.unique(np.concatenate([np.linspace(-HALF_PI, HALF_PI, 11), thetas]))
    phi = np.unique(np.concatenate([np.linspace(-math.pi, math.pi, 13), phis]))
    return torch.tensor(theta), torch.tensor(phi)


def nodes(edges: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """Gauss-Legendre nodes and weights `[cells, count]` between consecutive edges."""
    x, w = gauss_legendre(count)
    half = (edges[1:] - edges[:-1])[:, None] / 2
    return edges[:-1, None] + half * (1 + x), half * w


def cell_mass(log_prob, theta_edges: Tensor, phi_edges: Tensor, count: int, jacobian: bool = True) -> Tensor:
    """Integral of the density over every cell `[theta cells, phi cells]`."""
    (t, wt), (p, wp) = nodes(theta_edges, count), nodes(phi_edges, count)
    weight = wt * torch.cos(t) if jacobian else wt
    rows = []
    for i in range(t.shape[0]):
        omega = torch.stack(torch.broadcast_tensors(t[i][:, None, None], p), dim=-1)
        density = torch.exp(log_prob(omega))
        rows.append(torch.einsum("a,abc,bc->b", weight[i], density, wp))
    return torch.stack(rows)


def chi_square(omega: Tensor, mass: Tensor, theta_edges: Tensor, phi_edges: Tensor) -> float:
    """p-value of the counts against the expected cell masses; cells that expect fewer than 5 samples are pooled."""
    omega = omega.double()
    i = (torch.searchsorted(theta_edges, omega[:, 0].contiguous(), right=True) - 1).clamp(0, mass.shape[0] - 1)
    j = (torch.searchsorted(phi_edges, omega[:, 1].contiguous(), right=True) - 1).clamp(0, mass.shape[1] - 1)
    counts = torch.bincount(i * mass.shape[1] + j, minlength=mass.numel()).double()
    expected = (mass / mass.sum()).flatten() * len(omega)
    small = expected < 5
    observed = torch.cat([counts[~small], counts[small].sum().reshape(1)])
    expected = torch.cat([expected[~small], expected[small].sum().reshape(1)])
    if expected[-1] < 5:  # too few even together: join them to the largest cell
        k = int(expected[:-1].argmax())
        observed[k] += observed[-1]
        expected[k] += expected[-1]
        observed, expected = observed[:-1], expected[:-1]
    statistic = ((observed - expected) ** 2 / expected).sum().item()
    return float(chi2.sf(statistic, len(expected) - 1))


def order(name: str) -> int:
    return 40 if name in ("environment oblique", "environment one row") else 10


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
@pytest.mark.parametrize("name", LIGHTS)
def test_samples_follow_the_density(name: str, dtype: torch.dtype) -> None:
    light = LIGHTS[name]()
    dist = light.proposal()(CONTEXT.to(dtype))
    omega, log_prob = dist.sample_with_log_prob(uniforms(SAMPLES, dist.dimension, dtype=dtype))
    assert omega.dtype == log_prob.dtype == dtype
    assert (omega[:, 0].abs() <= HALF_PI + 1e-7).all() and (omega[:, 1].abs() <= math.pi + 1e-6).all()
    assert torch.isfinite(log_prob).all()
    edges = cells(light)
    mass = cell_mass(dist.log_prob, *edges, order(name))
    assert abs(mass.sum().item() - 1) < (2e-3 if order(name) == 40 else 1e-8)
    assert chi_square(omega, mass, *edges) > SIDAK
    # Negative control: the same counts against a density without the cos(theta) of the measure. Over a lobe of 0.1
    # degrees away from the poles cos(theta) is constant, and nothing can be seen.
    if name != "vmf tenth of a degree":
        assert chi_square(omega, cell_mass(dist.log_prob, *edges, order(name), jacobian=False), *edges) < 1e-6


@pytest.mark.parametrize("name", LIGHTS)
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_light_sampling_integrates_the_light(name: str, dtype: torch.dtype) -> None:
    light = LIGHTS[name]()
    dist = light.proposal()(CONTEXT)
    omega, log_prob = dist.sample_with_log_prob(uniforms(100_000, dist.dimension, seed=2, dtype=dtype))
    value = (light(omega) / torch.exp(log_prob)[:, None]).double()
    if isinstance(light, VonMisesFisherLights):
        truth = light.total()
    else:
        edges = cells(light)
        truth = torch.stack(
            [
                cell_mass(lambda w, c=c: torch.log(light(w)[..., c]), *edges, order(name)).sum()
                for c in range(light.channels)
            ]
        )
    error = value.std(0) / len(value) ** 0.5
    tolerance = 4.5 * error + truth * (1e-3 if order(name) == 40 else 1e-6 if dtype == torch.float32 else 1e-9)
    assert ((value.mean(0) - truth).abs() <= tolerance).all(), (value.mean(0), truth, error)
    mean = value.mean(-1)
    ratio = mean / mean.mean()
    if isinstance(light, EnvironmentLight):
        assert ratio.max() < 2.01 and ratio.var() < 0.02  # the claim in the module's text
    else:
        assert (ratio - 1).abs().max() < (1e-9 if dtype == torch.float64 else 0.02)


@pytest.mark.parametrize("kappa", [0.0, 1e-12, 1e-4, 9.9e-3, 1.01e-2, 1.0, 50.0, 1e6])
def test_lobe_normalisation_and_mean_cosine(kappa: float) -> None:
    """C(kappa) against a formula in Bessel functions, and the mean cosine coth(kappa) - 1/kappa = I_{3/2} / I_{1/2}."""
    light = VonMisesFisherLights([[0.0, 0.0, 1.0]], kappa)
    peak = light(to_angles(torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64))).item()
    truth = kappa**0.5 / ((2 * math.pi) ** 1.5 * ive(0.5, kappa)) if kappa > 0 else 1 / (4 * math.pi)
    assert peak == pytest.approx(truth, rel=1e-12)
    dist = light.proposal()(CONTEXT)
    cosine = to_vector(dist.sample(uniforms(40_000, 3)))[:, 2]
    mean = ive(1.5, kappa) / ive(0.5, kappa) if kappa > 0 else 0.0
    assert abs(cosine.mean().item() - mean) < 4.5 * cosine.std().item() / 200 + 1e-15


def test_peak_intensities_and_ambient() -> None:
    light = VonMisesFisherLights(
        [[0.1, 0.2], [0.1, 2.2]], [1e5, 1e5], [[3.0, 1.0], [0.5, 0.0]], [0.25, 1.0], kind="peak"
    )
    value = light(torch.tensor([[0.1, 0.2], [0.1, 2.2], [-1.0, 0.0]], dtype=torch.float64))
    assert torch.allclose(value, torch.tensor([[3.25, 2.0], [0.75, 1.0], [0.25, 1.0]], dtype=torch.float64), rtol=1e-13)


def test_narrow_lobe_keeps_its_shape_in_float32() -> None:
    light = VonMisesFisherLights([[0.4, -2.0]], 1e6)
    offset = torch.linspace(-4e-3, 4e-3, 41, dtype=torch.float64)
    omega = torch.stack([0.4 + offset, torch.full_like(offset, -2.0)], dim=-1).float()
    truth = light(omega.double())
    assert torch.allclose(light(omega).double(), truth, rtol=5e-3, atol=1e-4)


def reference_bilinear(image: np.ndarray, vector: np.ndarray) -> np.ndarray:
    """The documented convention, by scipy, from vectors in the map's frame."""
    height, width, _ = image.shape
    latitude, longitude = np.arcsin(vector[:, 1]), np.arctan2(vector[:, 0], vector[:, 2])
    rows = np.pi / 2 - np.pi * (np.arange(height) + 0.5) / height
    columns = np.pi - 2 * np.pi * (np.arange(-1, width + 1) + 0.5) / width
    padded = np.concatenate([image[:, -1:], image, image[:, :1]], axis=1)
    latitude = np.clip(latitude, rows[-1], rows[0])
    interpolate = RegularGridInterpolator((rows[::-1], columns[::-1]), padded[::-1, ::-1])
    return interpolate(np.stack([latitude, longitude], axis=-1))


@pytest.mark.parametrize("turn", [None, rotation(7)])
def test_environment_lookup_follows_the_convention(turn: Tensor | None) -> None:
    image = picture(6, 10)
    light = EnvironmentLight(image, 2.0, turn)
    world = torch.randn(2000, 3, generator=torch.Generator().manual_seed(4), dtype=torch.float64)
    world = torch.cat(
        [world, torch.tensor([[0.0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1], [1, 0, 0]], dtype=torch.float64)]
    )
    world = world / world.norm(dim=-1, keepdim=True)
    value = light(to_angles(light.to_fibre(world)))
    # The poles lie on a whole row of equal latitude: any longitude will do only there, compare to the rows.
    inner = world[:, 1].abs() < 1
    truth = 2 * reference_bilinear(image.numpy(), world[inner].numpy())
    assert np.abs(value[inner].numpy() - truth).max() < 1e-11
    assert 0 <= value[~inner].min() and value[~inner].max() <= 2 * image[[0, -1]].max()


def test_texel_directions() -> None:
    """Longitude 0 is +z in the middle of the map, longitude pi/2 is +x to its left, row 0 is up."""
    image = torch.full((2, 4, 1), 0.1, dtype=torch.float64)
    image[0, 1] = 5.0  # latitude 45, longitude 45 degrees
    light = EnvironmentLight(image)
    direction = torch.tensor([0.5, math.sqrt(0.5), 0.5], dtype=torch.float64)
    assert light(to_angles(direction)).item() == pytest.approx(5.0, rel=1e-12)


def test_environment_density_is_positive_wherever_the_radiance_is() -> None:
    image = torch.zeros(12, 24, 3)
    image[5, 7, 1] = 1e-20
    image[0, 3, 0] = 1e20
    image[11, 0, 2] = 1.0
    light = EnvironmentLight(image)
    omega = torch.stack(
        [torch.asin(2 * uniforms(50_000, 2)[:, 0] - 1), math.pi * (2 * uniforms(50_000, 2)[:, 1] - 1)], -1
    )
    for w in (omega, omega.float()):
        lit = (light(w) > 0).any(-1)
        assert 0.01 < lit.double().mean() < 0.2
        assert torch.equal(torch.isfinite(light.proposal()(CONTEXT).log_prob(w)), lit)


@pytest.mark.parametrize("name", ["vmf mixture", "environment", "environment oblique"])
def test_rotation_moves_light_and_density_alike(name: str) -> None:
    light = LIGHTS[name]().rotated(None)
    turns = torch.stack([rotation(s) for s in range(5)])
    batch = light.rotated(turns)
    context = Context(torch.zeros(5))
    dimension = light.proposal()(CONTEXT).dimension
    u = uniforms(60, dimension).reshape(12, 5, dimension)
    omega, log_prob = batch.proposal()(context).sample_with_log_prob(u)
    assert omega.shape == (12, 5, 2)
    for k in range(5):
        single = light.rotated(turns[k])
        alone, log_alone = single.proposal()(CONTEXT).sample_with_log_prob(u[:, k])
        assert torch.allclose(to_vector(alone), to_vector(omega[:, k]), atol=1e-12)
        assert torch.allclose(log_alone, log_prob[:, k], atol=1e-6)
        # What a rotation means: the value at R w is the unrotated value at w.
        world = to_angles(to_vector(alone) @ turns[k])
        assert torch.allclose(single(alone), light(world), rtol=1e-6, atol=1e-9)
        assert torch.allclose(batch(omega)[:, k], single(omega[:, k]), rtol=1e-12)
    with pytest.raises(InputError, match="rotation"):
        batch.breakpoints()
    assert light.rotation is None and batch.rotation is not None


@pytest.mark.parametrize("name", LIGHTS)
def test_gradients_are_finite_and_right(name: str) -> None:
    light = LIGHTS[name]()
    special = torch.tensor([[HALF_PI, 0.0], [-HALF_PI, 1.0], [0.0, math.pi], [0.0, -math.pi]], dtype=torch.float64)
    dist = light.proposal()(CONTEXT)
    omega = torch.cat([dist.sample(uniforms(200, dist.dimension)), special]).requires_grad_()
    for value in (light(omega).sum(), dist.log_prob(omega).clamp_min(-1e4).sum()):
        if value.requires_grad:
            (gradient,) = torch.autograd.grad(value, omega)
            assert torch.isfinite(gradient).all()
    u = uniforms(50, dist.dimension).requires_grad_()
    (gradient,) = torch.autograd.grad(dist.sample(u).sum(), u)
    assert torch.isfinite(gradient).all()
    inner = dist.sample(uniforms(6, dist.dimension, seed=9)).detach().requires_grad_()
    if name != "constant":
        assert torch.autograd.gradcheck(light, inner, eps=1e-9, atol=1e-3, rtol=1e-3)


def test_gradients_reach_the_parameters_of_lobes() -> None:
    def power(kappa: Tensor, intensity: Tensor) -> Tensor:
        light = VonMisesFisherLights([[0.2, 0.5], [0.1, 2.0]], kappa, intensity)
        return light(torch.tensor([[0.25, 0.5], [-1.0, 1.0]], dtype=torch.float64))

    kappa = torch.tensor([3e-3, 40.0], dtype=torch.float64, requires_grad=True)
    intensity = torch.tensor([[1.0, 2.0], [0.5, 0.1]], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(power, (kappa, intensity))


def test_breakpoints_make_narrow_lobes_integrable() -> None:
    light = LIGHTS["vmf mixture"]()
    theta, phi = cells(light)
    total = torch.stack([cell_mass(lambda w, c=c: torch.log(light(w)[..., c]), theta, phi, 16).sum() for c in range(3)])
    assert torch.allclose(total, light.total(), rtol=1e-10)


@pytest.mark.parametrize(
    ("build", "field"),
    [
        (lambda: ConstantLight(-1.0), "radiance"),
        (lambda: ConstantLight(math.nan), "radiance"),
        (lambda: ConstantLight("bright"), "radiance"),
        (lambda: ConstantLight([[1.0]]), "radiance"),
        (lambda: VonMisesFisherLights([[0.0, 0.0, 0.0]], 1.0), "directions"),
        (lambda: VonMisesFisherLights([[0.0, 0.0, math.inf]], 1.0), "directions"),
        (lambda: VonMisesFisherLights([[0.0], [1.0]], 1.0), "directions"),
        (lambda: VonMisesFisherLights([[0.0, 0.0]], -1.0), "kappa"),
        (lambda: VonMisesFisherLights([[0.0, 0.0]], 1e7), "kappa"),
        (lambda: VonMisesFisherLights([[0.0, 0.0]], [1.0, 2.0]), "kappa"),
        (lambda: VonMisesFisherLights([[0.0, 0.0]], 1.0, -1.0), "intensity"),
        (lambda: VonMisesFisherLights([[0.0, 0.0]], 1.0, 0.0), "intensity"),
        (lambda: VonMisesFisherLights([[0.0, 0.0]] * 2, 1.0, [[1.0]]), "intensity"),
        (lambda: VonMisesFisherLights([[0.0, 0.0]], 1.0, [[1.0, 2.0]], [1.0, 2.0, 3.0]), "ambient"),
        (lambda: VonMisesFisherLights([[0.0, 0.0]], 1.0, kind="mean"), "kind"),
        (lambda: VonMisesFisherLights([[0.0, 0.0]], 1.0, rotation=torch.eye(2)), "rotation"),
        (lambda: VonMisesFisherLights([[0.0, 0.0]], 1.0, rotation=2 * torch.eye(3)), "rotation"),
        (lambda: VonMisesFisherLights([[0.0, 0.0]], 1.0, rotation=-torch.eye(3)), "rotation"),
        (lambda: EnvironmentLight(torch.ones(4, 8)), "image"),
        (lambda: EnvironmentLight(torch.ones(0, 8, 3)), "image"),
        (lambda: EnvironmentLight(torch.ones(4, 8, 3), 0.0), "scale"),
    ],
)
def test_bad_input_is_named(build, field: str) -> None:
    with pytest.raises(InputError) as caught:
        build()
    assert caught.value.field == field


def test_modules_move_and_print() -> None:
    light = EnvironmentLight(picture(4, 8)).to(torch.float32)
    assert light.image.dtype == torch.float32 and light.row_mass.dtype == torch.float64
    assert "8 x 4" in repr(light) and "3 lobes" not in repr(light)
    omega = torch.tensor([[0.1, 0.2]])
    assert light(omega).dtype == torch.float32
    again = EnvironmentLight(torch.ones(4, 8, 3))
    again.load_state_dict(light.state_dict())
    assert torch.equal(again(omega), light(omega))
    assert torch.equal(again.proposal()(CONTEXT).log_prob(omega), light.proposal()(CONTEXT).log_prob(omega))


def test_a_scale_beyond_the_largest_number_is_refused() -> None:
    with pytest.raises(InputError, match="scale"):
        EnvironmentLight(torch.full((1, 1, 1), 1e300, dtype=torch.float64), 1e300)
