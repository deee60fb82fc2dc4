"""Errors of images with known noise."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from dsfit.errors import InputError
from dsfit.render.images import RenderImage, hdr_flip, image_errors, luminance, relative_squared_error, signed_error
from dsfit.render.images.flip import exposures
from dsfit.render.images.metrics import ImageErrors

SIZE = (96, 80)


def truth(seed: int = 1) -> torch.Tensor:
    """Smooth, with dark and bright pixels."""
    y, x = torch.meshgrid(*(torch.linspace(0, 1, k, dtype=torch.float64) for k in SIZE), indexing="ij")
    base = 0.02 + (torch.sin(5 * x + seed) * torch.cos(7 * y)).square()
    return torch.stack([base, 0.6 * base, 0.3 * base], -1)


def noisy(spread: float, seed: int) -> RenderImage:
    """The truth with noise of relative standard deviation `spread` and stated variance."""
    g = torch.Generator().manual_seed(seed)
    exact = truth()
    return RenderImage(
        exact + spread * exact * torch.randn(exact.shape, generator=g, dtype=torch.float64), (spread * exact).square()
    )


def test_the_references_noise_is_subtracted() -> None:
    image, reference = noisy(0.2, 5), noisy(0.2, 6)
    found = image_errors(image, reference)
    exact = 0.04 * float(truth().square().mean())
    assert found.mse.measured > exact + 10 * found.mse.standard_error  # uncorrected, it is plainly wrong
    assert abs(found.mse.value - exact) < 4 * found.mse.standard_error
    assert found.mse.of_reference == pytest.approx(exact, rel=1e-9)
    assert found.rmse == pytest.approx(math.sqrt(found.mse.measured))
    assert found.mse.root == pytest.approx(math.sqrt(exact), rel=0.05)
    assert found.predicted == pytest.approx(exact, rel=1e-9)
    assert found.pixels == SIZE[0] * SIZE[1]


def test_the_standard_error_covers_the_truth_as_often_as_it_should() -> None:
    exact = 0.04 * float(truth().square().mean())
    scores = []
    for seed in range(60):
        found = image_errors(noisy(0.2, 100 + seed), noisy(0.1, 300 + seed)).mse
        scores.append((found.value - exact) / found.standard_error)
    scores = np.array(scores)
    assert abs(scores.mean()) < 4 * scores.std() / math.sqrt(60)
    assert 0.3 < scores.std() < 1.2  # includes the pixels' own differences, so rather below 1


def test_relative_errors_are_corrected_to_first_order() -> None:
    image, reference = noisy(0.2, 7), noisy(0.02, 8)
    found = image_errors(image, reference, eps=1e-6)
    scale = truth().square() + 1e-6
    expected = float((0.04 * truth().square() / scale).mean())
    assert abs(found.relative.value - expected) < 4 * found.relative.standard_error + 0.002 * expected
    assert found.relative.of_reference == pytest.approx(expected / 100, rel=0.01)
    assert found.eps == 1e-6


def test_a_bias_stays_in_the_corrected_error() -> None:
    reference, image = noisy(0.05, 9), noisy(0.05, 10)
    shifted = RenderImage(image.radiance + 0.1, image.variance)
    found = image_errors(shifted, reference)
    expected = 0.01 + 0.0025 * float(truth().square().mean())
    assert abs(found.mse.value - expected) < 4 * found.mse.standard_error
    assert found.mse.value > 3 * found.predicted  # what tells a biased image


def test_an_image_as_good_as_the_reference_has_an_error_of_about_zero() -> None:
    found = image_errors(RenderImage(truth()), noisy(0.1, 11))
    assert abs(found.mse.value) < 4 * found.mse.standard_error
    assert math.isnan(found.predicted)
    lucky = image_errors(noisy(0.1, 12), noisy(0.1, 12))
    assert lucky.mse.measured == 0 and lucky.mse.value < 0 and lucky.mse.root == 0


def test_without_a_variance_nothing_is_corrected() -> None:
    reference = noisy(0.1, 13)
    unknown = reference.variance.clone()
    unknown[3, 4] = math.nan
    for bare in (RenderImage(reference.radiance), RenderImage(reference.radiance, unknown)):
        found = image_errors(noisy(0.1, 14), bare)
        assert found.mse.measured > 0
        assert all(math.isnan(x) for x in (found.mse.of_reference, found.mse.value, found.mse.standard_error))
        assert math.isnan(found.mse.root)


def test_only_covered_pixels_count_and_the_worst_are_trimmed() -> None:
    reference = RenderImage(truth(), coverage=torch.zeros(SIZE, dtype=torch.float64))
    reference.coverage[:50, :40] = 0.25
    image = truth()
    image[:50, :40] *= 1.1
    image[80] += 100  # outside
    image[10, 10] += 10  # one firefly
    found = image_errors(RenderImage(image), reference)
    eps = 0.01 * float(truth()[:50, :40].square().mean())
    assert found.pixels == 2000 and found.trimmed_pixels == 2 and found.eps == pytest.approx(eps)
    assert found.trimmed < 0.0101 < 0.1 < found.relative.measured


def test_relative_errors_do_not_depend_on_brightness() -> None:
    def errors(scale: float) -> ImageErrors:
        return image_errors(RenderImage(scale * noisy(0.2, 15).radiance), RenderImage(scale * noisy(0.1, 16).radiance))

    assert errors(1e-3).relative.measured == pytest.approx(errors(1.0).relative.measured, rel=1e-9)


def test_maps_are_what_their_formulas_say() -> None:
    image, reference = truth(1), truth(2)
    signed = signed_error(image, reference)
    assert torch.allclose(signed, luminance(image) - luminance(reference))
    relative = relative_squared_error(image, reference, 0.5)
    by_hand = ((image - reference) ** 2 / (reference**2 + 0.5)).mean(-1)
    assert torch.allclose(relative, by_hand)
    found = image_errors(RenderImage(image), RenderImage(reference), eps=0.5)
    assert found.relative.measured == pytest.approx(float(relative.mean()))


def test_images_that_cannot_be_compared_are_refused() -> None:
    good, nan = truth(), truth()
    nan[1, 2, 0] = math.nan
    for image, reference, message in (
        (good[:5], good, "80 x 5 pixels with 3 channels.*80 x 96"),
        (good[..., :1], good, "1 channel"),
        (nan, good, "image.*row 1, column 2"),
        (good, nan, "reference.*row 1, column 2"),
    ):
        pair = RenderImage(image), RenderImage(reference)
        for compare in (image_errors, hdr_flip):
            with pytest.raises(InputError, match=message):
                compare(*pair)
    with pytest.raises(InputError, match="eps"):
        image_errors(RenderImage(good), RenderImage(good), eps=0.0)
    with pytest.raises(InputError, match="coverage"):
        image_errors(RenderImage(good), RenderImage(good, coverage=torch.zeros(SIZE)))


def test_flip_grows_with_noise_and_knows_what_the_reference_costs() -> None:
    exact = RenderImage(truth(), torch.zeros_like(truth()))
    assert hdr_flip(exact, exact).mean == 0.0 and hdr_flip(exact, exact).of_reference == 0.0
    means = [hdr_flip(noisy(spread, 21), exact).mean for spread in (0.05, 0.2, 0.8)]
    assert 0 < means[0] < means[1] < means[2] < 1
    reference = noisy(0.1, 22)
    found = hdr_flip(RenderImage(truth()), reference)
    assert found.of_reference == pytest.approx(found.covered, rel=0.05)
    assert found.map.shape == SIZE and float(found.map.mean()) == pytest.approx(found.mean)


def test_flip_exposures_are_the_papers_over_covered_pixels() -> None:
    import flip_evaluator

    reference = RenderImage(truth().to(torch.float32))
    first, last, count = exposures(reference)
    _, mean, theirs = flip_evaluator.evaluate(
        reference.radiance.numpy(), 1.1 * reference.radiance.numpy(), "HDR", applyMagma=False
    )
    assert (first, last, count) == pytest.approx(
        (theirs["startExposure"], theirs["stopExposure"], theirs["numExposures"]), abs=2e-3
    )
    assert hdr_flip(RenderImage(1.1 * reference.radiance), reference).mean == pytest.approx(mean, rel=0.01)
    sparse, covered = truth(), torch.zeros(SIZE)
    sparse[30:] = 0  # a black background: the package would take 24 exposures for it
    covered[:30] = 1
    first, last, count = exposures(RenderImage(sparse, coverage=covered))
    assert last - first < 8 and count <= 8
    black = RenderImage(torch.zeros(8, 8, 3))  # the package would end the process
    assert hdr_flip(black, black).mean == 0.0 and hdr_flip(RenderImage(torch.ones(8, 8, 3)), black).mean > 0.5


def test_flip_takes_grey_images_negative_radiance_and_other_distances() -> None:
    grey = RenderImage(truth()[..., :1])
    wide = RenderImage(truth()[..., :1].expand(*SIZE, 3))
    shifted = [RenderImage(one.radiance - 0.1) for one in (grey, wide)]
    assert hdr_flip(shifted[0], grey).mean == hdr_flip(shifted[1], wide).mean
    rough = RenderImage(truth() * (1 + 0.5 * torch.randn(*SIZE, 1, generator=torch.Generator().manual_seed(1))))
    near, far = (hdr_flip(rough, RenderImage(truth()), pixels_per_degree=ppd).mean for ppd in (20.0, 120.0))
    assert near > far
    with pytest.raises(InputError, match="pixels_per_degree"):
        hdr_flip(grey, grey, pixels_per_degree=0.0)
