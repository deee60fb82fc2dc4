"""Layers in EXR, tone maps, PNG."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import OpenEXR
import pytest
import torch
from PIL import Image

from dsfit.errors import InputError
from dsfit.render.images import RenderImage, ToneMap, luminance, read_image, write_image, write_png
from dsfit.scene.exr import write_exr

G = torch.Generator().manual_seed(3)


def picture(height: int = 5, width: int = 7, channels: int = 3) -> RenderImage:
    def plane(*more: int) -> torch.Tensor:
        return torch.rand(height, width, *more, generator=G, dtype=torch.float64)

    return RenderImage(
        plane(channels) * 3, plane(channels) * 1e-7, (plane() * 1e6).round(), plane() * 9, plane() * 1e-4,
        plane(), plane() * 50,
        {"dsfit.run": "abc", "dsfit.seed": "12345678901234567", "dsfit.seconds": 1.5, "dsfit.samples": 64},
    )  # fmt: skip


@pytest.mark.parametrize("channels", [1, 3])
def test_layers_and_attributes_are_read_back(tmp_path: Path, channels: int) -> None:
    image = picture(channels=channels)
    found = read_image(write_image(tmp_path / "a.exr", image))
    assert found.layers == image.layers == ("radiance", "variance", "samples", "n", "time", "coverage", "depth")
    for layer in image.layers:
        assert torch.equal(getattr(found, layer), getattr(image, layer).to(torch.float32)), layer
    assert found.attributes == image.attributes
    assert (found.height, found.width) == (5, 7) and bool(found.covered.all())
    assert [p.name for p in tmp_path.iterdir()] == ["a.exr"]


def test_channels_have_the_names_other_programs_know_and_are_never_half(tmp_path: Path) -> None:
    image = picture()
    half = RenderImage(image.radiance.half(), image.variance.half(), coverage=image.coverage.half())
    with OpenEXR.File(str(write_image(tmp_path / "a.exr", half)), separate_channels=True) as file:
        found = {name: channel.pixels.dtype for name, channel in file.channels().items()}
    assert set(found) == {"R", "G", "B", "A", "variance.R", "variance.G", "variance.B"}
    assert set(found.values()) == {np.dtype(np.float32)}


def test_images_of_other_programs_are_read_with_the_layers_they_have(tmp_path: Path) -> None:
    write_exr(tmp_path / "rgb.exr", {"RGB": np.ones((2, 3, 3), np.float32)})
    assert read_image(tmp_path / "rgb.exr").layers == ("radiance",)
    write_exr(tmp_path / "z.exr", {"Z": np.ones((2, 3), np.float32)})
    with pytest.raises(InputError, match="R, G, B or Y"):
        read_image(tmp_path / "z.exr")
    with pytest.raises(InputError, match="no such file"):
        read_image(tmp_path / "none.exr")


def test_layers_of_another_shape_are_refused() -> None:
    with pytest.raises(InputError, match="image.variance"):
        RenderImage(torch.zeros(2, 3, 3), torch.zeros(2, 3))
    with pytest.raises(InputError, match="image.n"):
        RenderImage(torch.zeros(2, 3, 3), n=torch.zeros(3, 2))
    with pytest.raises(InputError, match="image.radiance"):
        RenderImage(torch.zeros(2, 3, 4))


def test_the_tone_map_follows_its_formula() -> None:
    x = torch.tensor([-1.0, 0.0, 0.001, 0.05, 0.18, 0.5, 1.0, 7.0], dtype=torch.float64).reshape(1, -1, 1)
    shown = ToneMap(2.0, "srgb")(x).flatten().tolist()
    expected = [0, 0, 12.92 * 0.002, *(1.055 * y ** (1 / 2.4) - 0.055 for y in (0.1, 0.36)), 1, 1, 1]
    assert shown == pytest.approx(expected, abs=1e-12)
    y = 0.216 * (2.51 * 0.216 + 0.03) / (0.216 * (2.43 * 0.216 + 0.59) + 0.14)
    film = ToneMap(2.0, "filmic")(x).flatten()
    assert float(film[4]) == pytest.approx(1.055 * y ** (1 / 2.4) - 0.055, abs=1e-12)
    assert film[0] == 0 and float(film[-1]) == pytest.approx(1.0, abs=1e-12) and bool((film.diff() >= 0).all())
    assert float(ToneMap(1.0, "filmic")(torch.full((1, 1, 3), 1e38))[0, 0, 0]) == pytest.approx(1.0, abs=1e-6)


def test_the_exposure_is_one_over_the_99th_percentile_of_covered_pixels() -> None:
    radiance = torch.arange(1.0, 201.0, dtype=torch.float64).reshape(10, 20, 1).expand(10, 20, 3)
    assert ToneMap().fixed(radiance).exposure == pytest.approx(1 / 198, rel=1e-9)
    covered = torch.zeros(10, 20, dtype=torch.bool)
    covered[:5] = True
    assert ToneMap().fixed(radiance, covered).exposure == pytest.approx(1 / 99, rel=1e-9)
    assert ToneMap().fixed(radiance, covered & False).exposure == 1.0
    assert ToneMap().fixed(0 * radiance).exposure == 1.0
    assert ToneMap(0.25).fixed(radiance).exposure == 0.25
    colour = torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64)
    assert float(luminance(colour)) == pytest.approx(0.2126 + 2 * 0.7152 + 3 * 0.0722)


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_radiance_that_is_not_finite_is_refused(value: float) -> None:
    radiance = torch.ones(4, 5, 3)
    radiance[2, 3, 1] = value
    for tone_map in (ToneMap(), ToneMap(1.0, "srgb")):
        with pytest.raises(InputError, match="row 2, column 3"):
            tone_map.fixed(radiance)
    with pytest.raises(InputError, match="finite"):
        write_png("unused.png", radiance)


@pytest.mark.parametrize("wrong", [{"curve": "gamma"}, {"exposure": 0.0}, {"exposure": float("nan")}])
def test_wrong_tone_maps_are_refused(wrong: dict[str, object]) -> None:
    with pytest.raises(InputError, match=f"tonemap.{next(iter(wrong))}"):
        ToneMap(**wrong)


@pytest.mark.parametrize("channels", [1, 3])
def test_a_png_holds_the_rounded_values_and_what_was_done(tmp_path: Path, channels: int) -> None:
    display = torch.linspace(0, 1, 4 * 5 * channels, dtype=torch.float64).reshape(4, 5, channels)
    write_png(tmp_path / "a.png", display, {"Tone map": ToneMap(2.0, "srgb").describe()})
    with Image.open(tmp_path / "a.png") as image:
        found = np.asarray(image).reshape(4, 5, channels)
        assert image.text["Tone map"] == "exposure 2, clipped, sRGB transfer"
    assert np.array_equal(found, np.round(255 * display.numpy()).astype(np.uint8))
    assert [p.name for p in tmp_path.iterdir()] == ["a.png"]
