"""From config values to library objects: degrees, directions, lights, contexts."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import pytest
import torch

from dsfit.errors import InputError
from dsfit.experiment import build
from dsfit.experiment.reader import RawConfig
from dsfit.experiment.schema import Config
from dsfit.experiment.validation import load, validate
from dsfit.scene import write_exr

UNIFORM = {"name": "uniform", "kind": "uniform"}


def config(**data: Any) -> Config:
    return validate(RawConfig("a", "a.toml", {"methods": [UNIFORM], **data}))


def contexts(**data: Any) -> list[dict[str, Any]]:
    return list(build.context_values(config(contexts=data).contexts))


def test_fibre_overrides_come_in_degrees() -> None:
    fiber = build.fiber(config(fiber={"preset": "brown", "beta_deg": [5, 6, 7], "eta": 1.6, "gamma_tt_deg": 20}).fiber)
    assert torch.allclose(fiber.beta, torch.tensor([5.0, 6.0, 7.0], dtype=torch.float64) * math.pi / 180, rtol=1e-15)
    assert float(fiber.eta) == 1.6 and float(fiber.gamma_tt) == pytest.approx(math.radians(20), rel=1e-15)
    assert fiber.sigma_a.tolist() == [0.432, 0.612, 0.98]
    assert torch.allclose(fiber.alpha, torch.tensor([-7.5, 3.75, 11.25], dtype=torch.float64) * math.pi / 180)


def test_conventions() -> None:
    assert build.convention(config()).lobe_norm == "energy"
    assert build.convention(config(bsdf={"convention": "printed"})).lobe_norm == "printed"
    mixed = build.convention(config(bsdf={"convention": {"base": "printed", "density_power": 1}}))
    assert mixed.lobe_norm == "printed" and mixed.density_power == 1
    poisson = build.convention(config(bsdf={"convention": {"base": "consistent", "transmittance": "poisson"}}))
    assert poisson.transmittance == "poisson" and poisson.share == "complement"
    with pytest.raises(InputError, match="transmittance: got 'binomial'; allowed: one of 'power', 'poisson'"):
        build.convention(config(bsdf={"convention": {"base": "consistent", "transmittance": "binomial"}}))


def test_contexts_are_products_or_zipped() -> None:
    product = contexts(theta_r_deg=[0, 10], n=[0, 3])
    assert [(c["theta_r_deg"], c["n"], c["v"]) for c in product] == [
        (0, 0, None),
        (0, 3, None),
        (10, 0, None),
        (10, 3, None),
    ]
    zipped = contexts(theta_r_deg=[0, 10], n=[0, 3], v=[0.5], combine="zip")
    assert [(c["theta_r_deg"], c["n"], c["v"]) for c in zipped] == [(0, 0, 0.5), (10, 3, 0.5)]


def test_a_context_has_radians_and_v_follows_from_n() -> None:
    made = build.context(config(), {"theta_r_deg": 45.0, "phi_r_deg": 90.0, "n": 3.0, "v": None})
    assert made.batch_shape == () and made.dtype == torch.float64
    assert float(made.theta_r) == pytest.approx(math.pi / 4) and float(made.phi_r) == pytest.approx(math.pi / 2)
    assert float(made.v) == 0.0 and float(made.n) == 3.0


def test_a_slab_tells_contexts_their_n() -> None:
    slab = {"kind": "slab", "thickness": 4.0, "depth": 1.0, "density": 2.0, "hint": "mean"}
    values = {"theta_r_deg": 0.0, "phi_r_deg": 0.0, "n": 0.0, "v": None}
    made = build.context(config(scattering=slab), values)
    assert 1 < float(made.n) < 100 and 0 < float(made.v) < 1
    forward = build.context(config(scattering={**slab, "hint": "forward"}), values)
    assert float(forward.n) == pytest.approx(6.0, rel=1e-2)  # phi_i = pi: through the thick side


def test_lobes_have_their_width_direction_and_colour() -> None:
    lobe = {"theta_deg": 30, "phi_deg": 60, "width_deg": 5, "intensity": [1, 2, 3]}
    light = build.light(
        config(light={"kind": "lobes", "lobes": [lobe, {"theta_deg": 0, "width_deg": 90}], "ambient": 0.1})
    )
    assert light.channels == 3
    peak, aside = (torch.tensor([math.radians(30 + d), math.radians(60)], dtype=torch.float64) for d in (0.0, 5.0))
    far = torch.tensor([math.radians(-80), math.radians(-120)], dtype=torch.float64)
    top, flank, rest = light(peak), light(aside), light(far)
    assert float((top[2] - rest[2]) / (top[0] - rest[0])) == pytest.approx(3, rel=0.05)
    assert float((flank - rest)[2] / (top - rest)[2]) == pytest.approx(math.exp(-0.5), rel=0.02)


def test_an_environment_is_found_beside_its_config(tmp_path: Path) -> None:
    write_exr(tmp_path / "sky.exr", {"RGB": torch.full((4, 8, 3), 2.0)})
    text = "[light]\nkind = 'environment'\npath = 'sky.exr'\nscale = 3.0\n[[methods]]\nname = 'light'\nkind = 'light'\n"
    (tmp_path / "a.toml").write_text(text)
    light = build.light(load(tmp_path / "a.toml").config)
    assert torch.allclose(
        light(torch.tensor([0.1, 0.2], dtype=torch.float64)), torch.tensor([6.0] * 3, dtype=torch.float64)
    )


def test_tables_are_taken_where_they_are_right() -> None:
    assert build.bsdf(config()).precision == "table"
    assert build.bsdf(config(fiber={"eccentricity": 0.9})).precision == "exact"
    assert build.bsdf(config(bsdf={"precision": "exact"})).precision == "exact"


def test_scenes_are_kept_until_they_change(tmp_path: Path) -> None:
    def make(**data: Any) -> Any:
        return build.integrand(config(**data))

    assert make() is make(contexts={"n": [5]}) and make() is not make(fiber={"eta": 1.5})
    sky = {"kind": "environment", "path": str(tmp_path / "sky.exr")}
    write_exr(sky["path"], {"RGB": torch.ones(4, 8, 3)})
    before = make(light=sky)
    assert make(light=sky) is before
    write_exr(sky["path"], {"RGB": torch.ones(8, 16, 3)})
    assert make(light=sky) is not before
