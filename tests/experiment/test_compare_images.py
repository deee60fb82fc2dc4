"""`dsfit compare-images`: errors of image files, and what it refuses."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from typer.testing import CliRunner

from dsfit.cli import app
from dsfit.errors import InputError
from dsfit.experiment.compare_images import Comparison, caption, compare_files, rows
from dsfit.render.images import RenderImage, hdr_flip, image_errors, read_image, write_image
from dsfit.scene.exr import write_exr

CLI = CliRunner()


def write(path: Path, spread: float, seed: int, *, variance: bool = True, shape: tuple[int, ...] = (30, 40, 3)) -> Path:
    """A ramp with noise of this relative standard deviation, on a disc."""
    generator = torch.Generator().manual_seed(seed)
    x = torch.linspace(0.1, 2.0, shape[1]).reshape(1, -1, 1).expand(shape)
    y = torch.linspace(-1, 1, shape[0]).reshape(-1, 1)
    coverage = ((torch.linspace(-1, 1, shape[1]) ** 2 + y**2) < 1).float()
    noise = 1 + spread * torch.randn(shape, generator=generator)
    own = ((spread * x) ** 2) * coverage.unsqueeze(-1) if variance else None
    return write_image(path, RenderImage(x * noise * coverage.unsqueeze(-1), own, coverage=coverage))


def test_the_command_prints_the_errors_and_draws_their_maps(tmp_path: Path) -> None:
    image, reference = write(tmp_path / "a.exr", 0.2, 1), write(tmp_path / "ref.exr", 0.05, 2)
    done = CLI.invoke(app, ["compare-images", str(image), str(reference)], catch_exceptions=False)
    assert done.exit_code == 0
    for words in ("RMSE", "relative MSE, eps", "without the worst 0.1 %", "FLIP, covered", "67 pixels per degree"):
        assert words in done.output
    with Image.open(tmp_path / "a-against-ref.png") as picture:
        assert picture.size[0] > 2 * picture.size[1]
        assert len(np.unique(np.asarray(picture).reshape(-1, 4), axis=0)) > 100
    out = tmp_path / "maps" / "here"
    again = CLI.invoke(app, ["compare-images", str(image), str(reference), "--out", str(out)], catch_exceptions=False)
    assert again.exit_code == 0 and (out / "a-against-ref.png").is_file()


def test_the_table_has_the_references_share_and_what_is_left(tmp_path: Path) -> None:
    found = compare_files(write(tmp_path / "a.exr", 0.2, 1), write(tmp_path / "ref.exr", 0.1, 2))
    table = {name.split(",")[0]: cells for name, *cells in rows(found)}
    e = found.errors
    assert table["MSE"] == [f"{e.mse.measured:.4g}", f"{e.mse.of_reference:.4g}",
                            f"{e.mse.value:.4g} ± {e.mse.standard_error:.4g}"]  # fmt: skip
    assert float(table["RMSE"][2]) == pytest.approx(e.predicted**0.5, rel=0.1)
    assert found.flip.of_reference < found.flip.covered
    bare = compare_files(tmp_path / "a.exr", write(tmp_path / "bare.exr", 0.1, 2, variance=False))
    table = {name.split(",")[0]: cells for name, *cells in rows(bare)}
    assert table["MSE"][1:] == ["-", "-"] == table["RMSE"][1:]


def test_images_of_the_same_name_keep_apart_by_their_folders(tmp_path: Path) -> None:
    for folder in ("one", "two"):
        (tmp_path / folder).mkdir()
        write(tmp_path / folder / "image.exr", 0.1, len(folder), shape=(6, 7, 3))
    found = compare_files(tmp_path / "one" / "image.exr", tmp_path / "two" / "image.exr", tmp_path)
    assert found.picture == tmp_path / "one-image-against-two-image.png" and found.picture.is_file()


def test_images_of_other_programs_can_be_compared(tmp_path: Path) -> None:
    write_exr(tmp_path / "a.exr", {"RGB": np.full((8, 9, 3), 1.1, np.float32)})
    write_exr(tmp_path / "b.exr", {"RGB": np.full((8, 9, 3), 1.0, np.float32)})
    found = compare_files(tmp_path / "a.exr", tmp_path / "b.exr")
    assert found.errors.pixels == 72 and found.errors.rmse == pytest.approx(0.1, rel=1e-5)


@pytest.mark.parametrize(
    "other, words",
    [
        ({"dsfit.run": "a"}, "the same run"),
        ({"dsfit.run": "b", "dsfit.seed": "2", "dsfit.subsamples": 4}, "places"),
        ({"dsfit.run": "b", "dsfit.seed": "1", "dsfit.subsamples": 8}, "places"),
        ({"dsfit.run": "b", "dsfit.seed": "1", "dsfit.subsamples": 4}, None),
        ({}, None),
    ],
)
def test_images_that_share_noise_or_differ_in_rays_are_told(
    tmp_path: Path, other: dict[str, object], words: str | None
) -> None:
    own = {"dsfit.run": "a", "dsfit.seed": "1", "dsfit.subsamples": 4}
    for name, attributes in (("a", own), ("b", other)):
        write_image(tmp_path / f"{name}.exr", RenderImage(torch.ones(6, 7, 3), attributes=attributes))
    pair = [read_image(tmp_path / f"{name}.exr") for name in "ab"]
    text = caption(Comparison(*pair, image_errors(*pair), hdr_flip(*pair), tmp_path))
    assert words in text if words else "places" not in text and "same run" not in text


def test_what_cannot_be_compared_is_named(tmp_path: Path) -> None:
    image = write(tmp_path / "a.exr", 0.1, 1)
    wide, grey = (
        write(tmp_path / "w.exr", 0.1, 2, shape=(30, 41, 3)),
        write(tmp_path / "g.exr", 0.1, 2, shape=(30, 40, 1)),
    )
    (tmp_path / "text.exr").write_text("not an image")
    (tmp_path / "cut.exr").write_bytes(image.read_bytes()[:900])
    write_exr(tmp_path / "z.exr", {"Z": np.ones((30, 40), np.float32)})
    broken = torch.ones(30, 40, 3)
    broken[4, 5] = torch.nan
    write_image(tmp_path / "nan.exr", RenderImage(broken))
    for other, words in (
        (wide, "40 x 30 pixels, 3 channels'; allowed.*41 x 30"),
        (grey, "3 channels'; allowed.*1 channel"),
        (tmp_path / "none.exr", "none.exr.*no such file"),
        (tmp_path / "text.exr", "text.exr.*magic"),
        (tmp_path / "cut.exr", "cut.exr"),
        (tmp_path / "z.exr", "z.exr.*R, G, B or Y"),
        (tmp_path / "nan.exr", "reference.*row 4, column 5"),
        (tmp_path, "directory"),
    ):
        with pytest.raises(InputError, match=words):
            compare_files(image, other)
        done = CLI.invoke(app, ["compare-images", str(image), str(other)])
        assert done.exit_code == 2 and done.output.startswith("dsfit: ") and "Traceback" not in done.output
    (tmp_path / "file").write_text("")
    done = CLI.invoke(app, ["compare-images", str(image), str(image), "--out", str(tmp_path / "file" / "below")])
    assert done.exit_code == 1 and "Traceback" not in done.output
