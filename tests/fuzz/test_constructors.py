"""Constructors of fibres, contexts, BSDFs, lights, scattering and laws: any argument is taken or refused by name."""

from __future__ import annotations

from typing import Any

import torch
from hypothesis import given
from hypothesis import strategies as st

from dsfit import Context, Convention, DualScattering, Fiber
from dsfit.proposals import (
    BackScatterLobe,
    CauchyLobe,
    FiberAzimuth,
    GaussianLobe,
    Lobe,
    Mixture,
    OffsetAzimuth,
    ScatteredLobe,
    SplitGaussianLobe,
    TransmittanceGaussian,
    TruncatedGaussian,
    UniformAzimuth,
    UniformSphere,
    WrappedGaussian,
)
from dsfit.scene import (
    ConstantLight,
    ConstantScattering,
    EnvironmentLight,
    RectangleLight,
    RingLight,
    SlabScattering,
    SphereLight,
    SphereScattering,
    SunLight,
    TotalLight,
    VonMisesFisherLights,
)
from tests.fuzz.common import anything, attempt, finite, fuzz, mostly_fine, numbers, refused, tensors

FIELDS = list(Fiber.preset("blond").parameters())
FLOATS = (torch.float32, torch.float64)
dtypes = st.sampled_from([None] * 4 + [torch.float32, torch.float64, torch.float16, torch.int64, torch.complex64, "x"])
values = mostly_fine | anything


@fuzz(300)
@given(st.dictionaries(st.sampled_from([*FIELDS, "etaa"]), values, max_size=3), dtypes)
def test_fiber(fields: dict[str, Any], dtype: Any) -> None:
    fiber = attempt(Fiber.preset, "blond", dtype=dtype, **fields)
    if not refused(fiber):
        finite(*fiber.parameters().values())
        assert fiber.dtype in FLOATS and {x.dtype for x in fiber.parameters().values()} == {fiber.dtype}
        assert isinstance(fiber.batch_shape, torch.Size)


@fuzz(300)
@given(values, values, values, st.none() | values, dtypes)
def test_context(theta_r: Any, phi_r: Any, n: Any, v: Any, dtype: Any) -> None:
    context = attempt(Context, theta_r, phi_r, n, v, dtype=dtype)
    if not refused(context):
        fields = (context.theta_r, context.phi_r, context.n, context.v)
        finite(*fields)
        assert {x.shape for x in fields} == {context.batch_shape}
        assert {x.dtype for x in fields} == {context.dtype} and context.dtype in FLOATS


@fuzz(150)
@given(
    st.sampled_from(["consistent", "printed", "x", 3, None]),
    st.dictionaries(
        st.sampled_from(["lobe_norm", "inverse_cos2", "density_power", "x"]), anything | st.just("energy"), max_size=2
    ),
)
def test_convention(name: Any, switches: dict[str, Any]) -> None:
    attempt(Convention.named, name, **switches)


@fuzz(150)
@given(
    values,
    values,
    st.sampled_from(["marschner", "raw", "simplified", "x", None, 1.0]),
    st.sampled_from(["exact", "table", "x", None]),
    tensors(),
)
def test_dual_scattering(d_f: Any, d_b: Any, azimuthal: Any, precision: Any, batch: Any) -> None:
    fiber = attempt(Fiber.preset, "blond", eta=batch)
    for one in (fiber, Fiber.preset("brown")):
        if not refused(one):
            attempt(DualScattering, one, d_f, d_b, azimuthal, precision=precision)
    attempt(DualScattering, d_f)


def _light(make: Any, *args: Any, **kwargs: Any) -> None:
    light = attempt(make, *args, **kwargs)
    if refused(light):
        return
    omega = torch.tensor([[0.3, 1.0], [-1.2, -2.0]], dtype=torch.float64)
    radiance = light(omega)
    finite(radiance)
    assert radiance.shape == (2, light.channels) and bool((radiance >= 0).all())
    u = torch.rand(5, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    distribution = light.proposal()(Context(0.1))
    drawn, log_prob = distribution.sample_with_log_prob(u[:, : distribution.dimension])
    finite(drawn, log_prob)
    light.breakpoints()


@fuzz(150)
@given(values)
def test_constant_light(radiance: Any) -> None:
    _light(ConstantLight, radiance)


vectors = st.lists(numbers, min_size=2, max_size=3) | st.lists(st.lists(numbers, min_size=2, max_size=3), max_size=2)


@fuzz(250)
@given(vectors | values, values, values, values, st.sampled_from(["total", "peak", "x", None]), st.none() | values)
def test_lobes_light(directions: Any, kappa: Any, intensity: Any, ambient: Any, kind: Any, rotation: Any) -> None:
    _light(VonMisesFisherLights, directions, kappa, intensity, ambient, kind=kind)
    _light(VonMisesFisherLights, [0.3, 0.2], 20.0, rotation=rotation)


places = st.lists(numbers, min_size=3, max_size=3) | values


@fuzz(300)
@given(places, places, places, values, values, values, st.booleans() | anything, st.none() | values)
def test_emitters(a: Any, b: Any, c: Any, size: Any, other: Any, radiance: Any, flag: Any, rotation: Any) -> None:
    _light(SunLight, a, size, radiance)
    _light(SunLight, a, radiance=radiance, rotation=rotation)
    _light(SphereLight, a, size, radiance, position=b)
    _light(RectangleLight, a, b, c, radiance, flag)
    _light(RectangleLight, a, [0.0, 0.0, 2.0], [3e-6, 0.0, 0.0], radiance, flag, position=b)
    _light(RingLight, a, b, size, other, radiance, flag, position=c)
    _light(TotalLight, [SphereLight([0.0, 0.0, 1.0], 0.5), ConstantLight()], [size, other])


images = st.tuples(
    st.integers(0, 4),
    st.integers(0, 4),
    st.integers(0, 3),
    st.lists(numbers, min_size=1, max_size=48),
    st.sampled_from([torch.float32, torch.float64, torch.float16, torch.int64, torch.complex64]),
)


@fuzz(250)
@given(images, st.just(1.0) | values, st.booleans())
def test_environment_light(image: Any, scale: Any, absolute: bool) -> None:
    h, w, c, elements, dtype = image
    pixels = torch.tensor((elements * 48)[: h * w * c], dtype=torch.float64).nan_to_num(1.0, 1.0, 1.0)
    pixels = pixels.abs() if absolute else pixels
    _light(EnvironmentLight, pixels.to(dtype).reshape(h, w, c), scale)
    _light(EnvironmentLight, elements)


def _scattering(make: Any, *args: Any, **kwargs: Any) -> None:
    scattering = attempt(make, *args, **kwargs)
    if refused(scattering):
        return
    omega = torch.tensor([[[0.3, 1.0]], [[-1.2, -2.0]], [[0.0, 3.1]]], dtype=torch.float64)
    context = Context(torch.tensor([0.1, 0.2, 0.3], dtype=torch.float64))
    found = attempt(scattering, omega, context)
    if refused(found):
        return
    finite(*found)
    assert bool((found[0] >= 0).all()) and bool((found[1] >= 0).all()) and bool((found[1] <= 1).all())


@fuzz(300)
@given(
    values, values, values, values | vectors, values | st.sampled_from(["poisson", "threshold"]), values, st.booleans()
)
def test_scattering(a: Any, b: Any, c: Any, vector: Any, v: Any, max_n: Any, aligned: bool) -> None:
    _scattering(ConstantScattering, a, v)
    _scattering(SlabScattering, a, b, c, vector, v, aligned=aligned, max_n=max_n)
    _scattering(SlabScattering, 2.0, 1.0, c, (0.0, 1.0, 0.0), v)
    _scattering(SphereScattering, a, b, vector, v, aligned=aligned)
    _scattering(SphereScattering, 2.0, b, vector, v)


LAWS: dict[str, Any] = {
    "GaussianLobe": (GaussianLobe, 2),
    "CauchyLobe": (CauchyLobe, 2),
    "SplitGaussianLobe": (SplitGaussianLobe, 3),
    "TransmittanceGaussian": (TransmittanceGaussian, 2),
    "ScatteredLobe": (ScatteredLobe, 3),
    "BackScatterLobe": (BackScatterLobe, 3),
    "WrappedGaussian": (WrappedGaussian, 1),
    "TruncatedGaussian": (TruncatedGaussian, 1),
    "OffsetAzimuth": (lambda eta: OffsetAzimuth("TT", eta), 1),
    "UniformAzimuth": (UniformAzimuth, 1),
    "FiberAzimuth": (FiberAzimuth, 1),
    "Lobe": (lambda a, b, c: Lobe("TT", a, b, c), 3),
    "Mixture": (lambda w, d: Mixture([UniformSphere(), UniformSphere()], w, d), 2),
}


@fuzz(500)
@given(st.sampled_from(list(LAWS)), st.lists(values, min_size=3, max_size=3))
def test_laws(name: str, arguments: list[Any]) -> None:
    make, count = LAWS[name]
    law = attempt(make, *arguments[:count])
    if not refused(law):
        finite(*(x for x in (*law.parameters(), *law.buffers())))
