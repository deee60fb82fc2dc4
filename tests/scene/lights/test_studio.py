"""The map that comparisons of renderings use: what the script makes, and what lamps it holds."""

from __future__ import annotations

import hashlib
from pathlib import Path

import torch

from dsfit.scene import EnvironmentLight, read_exr
from experiments.make_environment import LAMPS, TARGET, main, studio


def test_the_file_is_what_the_script_makes(tmp_path: Path) -> None:
    made = main(tmp_path / "studio.exr")
    assert torch.equal(read_exr(made).pixels, read_exr(TARGET).pixels)
    again = main(tmp_path / "again.exr")
    assert hashlib.md5(made.read_bytes()).digest() == hashlib.md5(again.read_bytes()).digest()
    assert TARGET.stat().st_size < 200_000


def test_small_lamps_hold_most_of_the_power() -> None:
    pixels = read_exr(TARGET).pixels.double()
    row = torch.cos(torch.pi * ((torch.arange(len(pixels)) + 0.5) / len(pixels) - 0.5))[:, None]
    power = pixels.mean(-1) * row
    lamps = pixels.mean(-1) > 20
    assert int(lamps.sum()) < 60 and 0.7 < float((power * lamps).sum() / power.sum()) < 0.95
    assert EnvironmentLight(pixels).covers()


def test_power_does_not_depend_on_the_grid() -> None:
    coarse, fine = (EnvironmentLight(studio(*size)).power() for size in ((128, 64), (256, 128)))
    assert abs(float(coarse / fine) - 1) < 0.05 and len(LAMPS) == 5
