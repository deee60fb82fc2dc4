"""Integrals of many contexts at once."""

from __future__ import annotations

import pytest
import torch

import dsfit
from dsfit.errors import InputError
from dsfit.race.references import StreamReference
from dsfit.scene import ConstantLight, SlabScattering
from dsfit.streams import ContextStream


def integrand(preset: str = "brown", azimuthal: str = "marschner", **options: object) -> dsfit.Integrand:
    fiber = dsfit.Fiber.preset(preset, eccentricity=1.0)
    return dsfit.Integrand(dsfit.DualScattering(fiber, azimuthal=azimuthal, precision="table"), **options)


@pytest.mark.parametrize("preset, azimuthal", [("brown", "marschner"), ("nonabsorbing", "simplified")])
def test_they_agree_with_the_adaptive_reference(preset: str, azimuthal: str) -> None:
    contexts = ContextStream(rule="mixed", direct=0.5).draw(2, torch.Generator().manual_seed(2))
    assert contexts.n[0] != contexts.n[1]
    assert StreamReference(integrand(preset, azimuthal)).check(contexts, rtol=1e-5) < 1e-5


def test_light_scales_them() -> None:
    contexts = dsfit.Context([0.2, -1.0], 0.0, [0.0, 5.0])
    reference = StreamReference(integrand(azimuthal="simplified"))
    plain = reference(contexts)
    reference.integrand = dsfit.Integrand(reference.bsdf, ConstantLight([2.0, 3.0, 4.0]))
    assert torch.allclose(reference(contexts), plain * plain.new_tensor([2.0, 3.0, 4.0]), rtol=1e-12)


def test_scenes_that_do_not_factor_are_refused() -> None:
    with pytest.raises(InputError, match="constant light"):
        StreamReference(integrand(scattering=SlabScattering(2.0, 1.0, 1.0)))
    eccentric = dsfit.DualScattering(dsfit.Fiber.preset("blond", eccentricity=0.9))
    with pytest.raises(InputError, match="round"):
        StreamReference(dsfit.Integrand(eccentric))
    printed = dsfit.DualScattering(dsfit.Fiber.preset("blond", eccentricity=1.0), convention="printed")
    with pytest.raises(InputError, match="convention"):
        StreamReference(dsfit.Integrand(printed))
