"""The integrand of a rendering is `Integrand` with every hit's own light, n and v, whatever evaluates it."""

from __future__ import annotations

import pytest
import torch

import dsfit
from dsfit.errors import InputError
from dsfit.render.integrand import HairIntegrand
from dsfit.scene import ConstantLight, ConstantScattering, SlabScattering
from dsfit.scene.lights.sun import SunLight
from tests.render import support_render as support


class Counting(SlabScattering):
    """Counts the directions it is asked for."""

    asked = 0

    def crossings(self, omega_i, context):
        self.asked += omega_i[..., 0].numel()
        return super().crossings(omega_i, context)


def directions(samples: int, hits: int, dtype: torch.dtype = torch.float64) -> torch.Tensor:
    generator = torch.Generator().manual_seed(4)
    z, turn = torch.rand(2, samples, hits, generator=generator, dtype=torch.float64)
    return torch.stack([torch.asin(2 * z - 1), (2 * turn - 1) * torch.pi], dim=-1).to(dtype)


def made(light, scattering, dtype=torch.float64, exact=True):
    scene = support.scene(light, grid=scattering, dtype=dtype, all_rays=True)
    hits = scene.hits(range(1, 3), range(1, 4))
    return scene.integrand(hits, exact=exact), scene.contexts(hits), hits


def test_it_is_the_plain_integrand_of_every_hit():
    light, scattering = support.narrow_light(5.0), SlabScattering(2.0, 0.7, 1.0)
    integrand, contexts, hits = made(light, scattering)
    omega = directions(30, len(hits))
    found = integrand(omega, contexts)
    for k in range(len(hits)):
        alone = dsfit.Integrand(integrand.bsdf, light.rotated(hits.frame[k]), scattering)
        plain = dsfit.Context(contexts.theta_r[k], contexts.phi_r[k])
        torch.testing.assert_close(found[:, k], alone(omega[:, k], plain), rtol=1e-12, atol=1e-300)
    some = contexts[[3, 1]]
    torch.testing.assert_close(integrand(omega[:, [3, 1]], some), found[:, [3, 1]], rtol=1e-12, atol=1e-300)


def test_the_kernel_agrees_with_torch():
    exact, contexts, hits = made(ConstantLight([1.0, 2.0, 0.5]), SlabScattering(2.0, 0.7, 1.0, v="threshold"))
    fast = made(ConstantLight([1.0, 2.0, 0.5]), SlabScattering(2.0, 0.7, 1.0, v="threshold"), torch.float32, False)
    assert fast[0].kernel is not None
    omega = directions(400, len(hits))
    expected, found = exact(omega, contexts), fast[0](omega.float(), fast[1])
    assert found.dtype == torch.float32
    error = (found - expected).abs() / (expected.abs() + 1e-3 * expected.amax((0, 1)))
    assert float(error.quantile(0.99)) < 5e-3


@pytest.mark.parametrize("exact", [True, False])
def test_directions_without_light_cost_nothing(exact):
    light = SunLight([0.2, 0.9, 0.4], 0.3, 2.0)
    scattering = Counting(2.0, 0.7, 1.0)
    integrand, contexts, hits = made(light, scattering, torch.float32, exact)
    omega = directions(300, len(hits), torch.float32)
    radiance = integrand.light_at(contexts)(omega)
    lit = (radiance > 0).any(-1)
    assert 0.005 < float(lit.float().mean()) < 0.1
    scattering.asked = 0
    found = integrand(omega, contexts)
    assert scattering.asked == int(lit.sum())
    whole = integrand._shaded(omega, contexts) * radiance
    torch.testing.assert_close(found, whole, rtol=2e-5, atol=1e-8)
    assert bool((found[lit] > 0).all()) and bool((found[~lit] == 0).all())
    nothing = integrand(omega[~lit.all(1)][:0], contexts)
    assert nothing.shape == (0, len(hits), 3)


def test_kernel_values_of_single_directions():
    integrand, contexts, hits = made(ConstantLight(1.0), ConstantScattering(2.0, 0.4), torch.float32, False)
    kernel, omega = integrand.kernel, directions(3, len(hits), torch.float32)
    ready = kernel.bare_contexts(dsfit.Context(contexts.theta_r, 0.0, 2.0, 0.4, dtype=torch.float32))
    phi = contexts.phi_r - omega[..., 1]
    expected = kernel.eval(ready, omega[..., 0].contiguous(), phi.contiguous())
    n, v = (torch.full((3 * len(hits),), x) for x in (2.0, 0.4))
    found = kernel.eval_each(contexts.theta_r.repeat(3), n, v, omega[..., 0].reshape(-1), phi.reshape(-1))
    torch.testing.assert_close(found.reshape(3, len(hits), 3), expected, rtol=1e-5, atol=1e-7)
    empty = torch.zeros(0)
    assert kernel.eval_each(empty, empty, empty, empty, empty).shape == (0, 3)


def test_it_is_even_only_where_everything_around_is_the_same():
    along = support.narrow_light().__class__(torch.tensor([[1.0, 0.0, 0.0]]), 20.0, 1.0)
    hits = made(ConstantLight(1.0), ConstantScattering(1.0, 0.0))[2]
    slab = SlabScattering(2.0, 0.5, 1.0, normal=(1.0, 0.0, 0.0))
    bsdf = support.bsdf()
    assert HairIntegrand(bsdf, ConstantLight(1.0), ConstantScattering(1.0, 0.0), hits).is_even
    # along the tangent of the world's frame is not along that of a fibre's
    assert not HairIntegrand(bsdf, along, ConstantScattering(1.0, 0.0), hits).is_even
    assert not HairIntegrand(bsdf, ConstantLight(1.0), slab, hits).is_even


def test_contexts_must_know_their_hits():
    integrand, contexts, _ = made(ConstantLight(1.0), ConstantScattering(1.0, 0.0))
    plain = dsfit.Context(contexts.theta_r, contexts.phi_r)
    with pytest.raises(InputError, match="HitContext"):
        integrand(directions(2, len(contexts)), plain)
    with pytest.raises(InputError, match="channels"):
        HairIntegrand(integrand.bsdf, ConstantLight([1.0, 1.0]), integrand.scattering, integrand.hits)
