"""Error against run time of estimators of the integral, and how far each density is from the best possible one."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from dsfit.experiment.files import number
from dsfit.figures import Close, Data, Estimate, Experiment, Measured, Settings, Work

_NOTHING = {"rmse": math.nan, "rmse_error": math.nan, "seconds": [math.nan] * 3}


class ErrorTime(Settings):
    """Contexts are all combinations of `fibres` (presets), `theta_r_deg` and `n`; v is 1 for n = 0, else 0. Each method
    is estimated with every number of `samples`, `repeats` times in each of `rounds`. `panels` are labels of
    contexts that get a panel of their own."""

    fibres: list[str]
    theta_r_deg: list[float]
    n: list[float]
    samples: list[int]
    repeats: int
    rounds: int
    seed: int
    panels: list[str]


def compute(settings: ErrorTime, work: Work) -> Data:
    """Every method at every context.

    Arrays by method: `excess.METHOD` `[contexts]`, M(p)/M* - 1, `variance.METHOD`, the relative variance of a sample
    (larger: channels differ from direction to direction even where the density is the best one), and `weight.METHOD`,
    the largest weight |F| / (p int |F|), by quadrature; `rmse.METHOD` `[contexts, samples]`, measured root mean squares
    of the relative error, and their standard errors `rmse_error.METHOD`; `time.METHOD` `[contexts, samples, 3]`,
    quartiles of the seconds of an estimate, and `per_sample.METHOD`, `fit_time.METHOD` `[contexts]`, seconds per sample
    and of the fit. `samples` are the numbers of samples.
    """
    quoted = ", ".join(f'"{name}"' for name in settings.fibres)
    overrides = (
        f'sweep.grid."fiber.preset"=[{quoted}]',
        f"contexts.theta_r_deg={settings.theta_r_deg}",
        f"contexts.n={settings.n}",
        f"estimate.samples={settings.samples}",
        f"estimate.repeats={settings.repeats}",
        f"estimate.rounds={settings.rounds}",
        f"estimate.seed={settings.seed}",
    )
    cells = work.run("bench_36.toml", overrides).result()["cells"]
    methods = [method["name"] for method in cells[0]["methods"]]
    arrays: dict[str, np.ndarray] = {"samples": np.array(settings.samples)}
    for k, name in enumerate(methods):
        found = [cell["methods"][k] for cell in cells]
        arrays |= {f"{key}.{name}": np.array(values) for key, values in _numbers(found, settings.samples).items()}
    labels = [cell["label"] for cell in cells]
    return Data(arrays, {"methods": methods, "contexts": labels, "panels": settings.panels})


def _numbers(found: list[dict[str, Any]], samples: list[int]) -> dict[str, list[Any]]:
    """The arrays of one method over contexts; nan where so few samples are no estimate."""
    points = [[{e["samples"]: e for e in m["estimates"]}.get(count, _NOTHING) for count in samples] for m in found]
    return {
        "excess": [number(m["excess"]) for m in found],
        "variance": [number(m["variance"]) for m in found],
        "weight": [number(m["largest_weight"]) for m in found],
        "rmse": [[number(point["rmse"]) for point in row] for row in points],
        "rmse_error": [[number(point["rmse_error"]) for point in row] for row in points],
        "time": [np.array([point["seconds"] for point in row], np.float32) for row in points],
        "per_sample": [number(m["seconds_per_sample"]) for m in found],
        "fit_time": [number(m["fit"]["seconds"]) if m["fit"] else math.nan for m in found],
    }


EXPERIMENT = Experiment(
    title="Error against run time of estimators",
    shows="Excess and time to 1 % error of the chapter's heuristics, their best mix and the fitted family over 36 "
    "contexts; what the fit costs, and from when on it pays.",
    settings=ErrorTime,
    compute=compute,
    minutes=5.1,
    reproduces={
        "time.*": Measured(),
        "per_sample.*": Measured(),
        "fit_time.*": Measured(),
        "rmse.*": Estimate("rmse_error.*"),
        "excess.fitted": Close(0.2),  # iterations amplify rounding
        "variance.fitted": Close(0.2),
        "weight.fitted": Close(1.0),
        "excess.best heuristic mix": Close(0.02),
        "weight.best heuristic mix": Close(0.2),
        "variance.best heuristic mix": Close(0.02),
        "excess.*": Close(1e-3),
        "variance.*": Close(1e-3),
        "weight.*": Close(0.05),  # the largest at the nodes of a quadrature
    },
    small=('fibres=["blond"]', "theta_r_deg=[45.0]", "n=[3.0]", "samples=[64, 256]", "repeats=4", "rounds=1"),
)
