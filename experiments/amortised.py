"""One proposal for every context of a fibre: its excess at contexts that it was not trained on."""

from __future__ import annotations

from typing import Any

import numpy as np

from dsfit.experiment.files import number
from dsfit.figures import Close, Data, Experiment, Measured, Settings, Work

QUANTILES = ("median", "p95", "p99", "worst")


class Amortised(Settings):
    """A training of `steps` for each of the `fibres` (presets), from a network with these `hidden` layers whose start
    is tabulated at so many `inclinations`; `seed` of the training."""

    fibres: list[str]
    steps: int
    inclinations: int
    hidden: list[int]
    seed: int


def compute(settings: Amortised, work: Work) -> Data:
    """Trains and judges.

    Arrays: `theta_r_deg`, `n`, `v` `[contexts]` and, for each FIBRE, `FIBRE.start` and `FIBRE.trained` `[contexts]`,
    the excess of the untrained and of the trained proposal (float32), `FIBRE.start.summary` and
    `FIBRE.trained.summary`, their median, 95 % and 99 % quantiles and maximum, `FIBRE.weight`, the largest weight a
    sample of the trained one can have anywhere, `FIBRE.beyond`, its excess at contexts outside the training's ranges
    (nan where float64 has no light left), and `FIBRE.seconds` of tables, targets and training.
    """
    quoted = ", ".join(f'"{name}"' for name in settings.fibres)
    overrides = (
        f'sweep.grid."fiber.preset"=[{quoted}]',
        f"amortise.steps={settings.steps}",
        f"amortise.inclinations={settings.inclinations}",
        f"amortise.hidden={settings.hidden}",
        f"estimate.seed={settings.seed}",
    )
    directory = work.run("amortised.toml", overrides)
    cells = directory.result()["cells"]
    arrays: dict[str, np.ndarray] = {}
    for cell in cells:
        found = directory.arrays(cell["index"])
        arrays |= {key: found[key] for key in ("theta_r_deg", "n", "v")}
        arrays |= {f"{cell['label']}.{key}": values for key, values in _numbers(cell, found).items()}
    record = {
        "fibres": [cell["label"] for cell in cells],
        "steps": cells[0]["training"]["steps"],
        "trained_on": cells[0]["training"]["contexts"],
        "parameters": cells[0]["training"]["parameters"],
        "worst_at": {cell["label"]: cell["held_out"]["where"] for cell in cells},
        "beyond": [[b["theta_r_deg"], b["n"]] for b in cells[0]["beyond"]],
    }
    return Data(arrays, record)


def _numbers(cell: dict[str, Any], found: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    seconds = cell["training"]["seconds"]
    return {
        "start": found["start_excess"].astype(np.float32),
        "trained": found["excess"].astype(np.float32),
        "start.summary": np.array([number(cell["start"][key]) for key in QUANTILES]),
        "trained.summary": np.array([number(cell["held_out"][key]) for key in QUANTILES]),
        "weight": np.array(number(cell["held_out"]["largest_weight"])),
        "beyond": np.array([number(b["excess"]) for b in cell["beyond"]], np.float32),
        "seconds": np.array([number(seconds[key]) for key in ("proposal", "targets", "training")]),
    }


EXPERIMENT = Experiment(
    title="Fitted once, sampled everywhere",
    shows="Excess of one proposal per fibre over all inclinations, depths and lit shares that it was not trained on: "
    "about 0.001 in the median, a hundredth at worst.",
    settings=Amortised,
    compute=compute,
    minutes=7.4,
    reproduces={
        "*.seconds": Measured(),
        "*.start": Close(1e-3, 1e-6),
        "*.start.summary": Close(1e-3),
        # Training amplifies rounding: another machine ends in another network, as good as this one.
        "*.trained.summary": Close(1.0),
        "*.trained": Close(1.0, 0.01),
        "*.beyond": Close(1.0, 0.02),
        "*.weight": Close(1.0),
        "worst_at.*": Measured(),  # where the largest of many like ones is
    },
    small=('fibres=["blond"]', "steps=60", "inclinations=48"),
)
