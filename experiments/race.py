"""The race: error against run time of every peer, over a stream of contexts as a renderer meets them and at single
ones."""

from __future__ import annotations

import numpy as np

from dsfit.experiment.files import number
from dsfit.experiment.race_summary import entrants
from dsfit.figures import Data, Estimate, Experiment, Measured, Settings, Work
from experiments._race_points import FIELDS, pack

_WIDTH = 2 * 1.96
"""Of a 95 % interval, in standard errors."""


class Race(Settings):
    """`config` has the peers. The stream has so many `contexts`; every peer gets `stream_seconds` CPU seconds for it
    and `single_seconds` for each combination of `theta_r_deg` and `n`, with `seeds` repeats; who is ahead is told after
    each of the `budgets` (seconds)."""

    config: str
    fibre: str
    contexts: int
    stream_seconds: float
    theta_r_deg: list[float]
    n: list[float]
    single_seconds: float
    seeds: int
    budgets: list[float]


def compute(settings: Race, work: Work) -> Data:
    """Runs the race.

    Arrays: those of `pack`, and for each peer on the stream at its fewest samples (`first.samples`) the error
    `first.rmse` with its standard error `first.error` (nan where the peer did not run): what another machine must find
    too, as how far a peer gets is a matter of time.
    """
    overrides = (
        f'fiber.preset="{settings.fibre}"',
        f"race.stream.count={settings.contexts}",
        f"race.stream.seconds={settings.stream_seconds}",
        f"contexts.theta_r_deg={settings.theta_r_deg}",
        f"contexts.n={settings.n}",
        f"race.single.seconds={settings.single_seconds}",
        f"race.single.seeds={settings.seeds}",
        f"race.budgets={settings.budgets}",
    )
    result = work.run(settings.config, overrides).result()
    arrays, peers = pack(result["cells"])
    first = dict(zip(FIELDS, np.moveaxis(arrays["points"][:, 0, 0].astype(float), -1, 0), strict=True))
    arrays |= {
        "first.samples": first["samples"],
        "first.rmse": first["value"],
        "first.error": (first["high"] - first["low"]) / _WIDTH,
    }
    single = next(cell["contexts"] for cell in result["cells"] if cell["group"] == "contexts" and cell.get("contexts"))
    record = {
        "title": result["title"],
        "peers": peers,
        "biased": [e.name for e in entrants(result["cells"]) if e.biased and not e.heavy],
        "contexts": [{key: number(row["context"][key]) for key in ("theta_r_deg", "n")} for row in single],
        "budgets": list(settings.budgets),
    }
    return Data(arrays, record)


EXPERIMENT = Experiment(
    title="The race: error against run time for 25 peers",
    shows="Who has the least error after so much time, with and without what a peer prepares: over 10,000 contexts and "
    "at single ones.",
    settings=Race,
    compute=compute,
    minutes=11.0,
    reproduces={
        "first.rmse": Estimate("first.error"),
        "points": Measured(),
        "rows": Measured(),
        "prepare": Measured(),
        "peers.*.biased": Measured(),  # heavy tails feign a bias now and then; `biased` leaves them out
    },
    small=(
        "config=race_quick.toml",
        "contexts=200",
        "stream_seconds=0.1",
        "theta_r_deg=[45.0]",
        "n=[0.0, 5.0]",
        "single_seconds=0.1",
        "seeds=16",
    ),
)
