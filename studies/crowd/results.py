"""What the tasks of the crowd study found, by model, scope and horizon; tables from it."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
import pandas as pd

from nnode.calibrate.resampling import Paired, group_weights, paired
from nnode.data.store import Store
from nnode.model.system import System
from studies.crowd import printed
from studies.crowd.data import ALL, mean_speed, sequences, time_groups
from studies.crowd.fit import NAMES, named, system_of
from studies.crowd.tasks import KINDS
from studies.options import CrowdStudyOptions

#: How the page calls what was simulated.
LABELS = {
    "sf": "SF",
    "nn": "NN",
    "wall": "NN, walls alone",
    "relaxation": "relaxation alone",
    "constant_velocity": "constant velocity",
    "even_pace": "even pace to the end",
    "printed": "SF, printed parameters",
}
MODELS = ("sf", "nn", "wall")
SIMPLE = ("relaxation", "constant_velocity", "even_pace", "printed")


@dataclass(frozen=True)
class One:
    """One calibration.

    Attributes:
        kind, scope, horizon, seed: which.
        row: ``(K,)`` parameters.
        J: mean cost of a training sequence, m² s.
        evaluations: simulations of all training sequences.
        train, heldout: cost by sequence, m² s.
    """

    kind: str
    scope: str
    horizon: float
    seed: int
    row: list[float]
    J: float
    evaluations: int
    train: dict[str, float]
    heldout: dict[str, float]

    @property
    def system(self) -> System:
        """The calibrated model."""
        return system_of(KINDS[self.kind], self.row)


@dataclass
class Crowd:
    """A study: options, prepared data by ``main`` or ``others`` and horizon (s), the paper's
    recording as it is, results."""

    options: CrowdStudyOptions
    stores: dict[tuple[str, float], Store]
    raw: str = ""
    found: dict[str, dict[str, Any]] = field(default_factory=dict)

    @property
    def horizons(self) -> list[float]:
        """s, ascending."""
        return self.options.horizons

    @property
    def scopes(self) -> list[str]:
        """All sequences, and all but each block of time."""
        return [ALL, *self.folds]

    @property
    def folds(self) -> list[str]:
        """The scopes that hold out a block."""
        return [f"fold-{n}" for n in range(self.options.folds)]

    @cached_property
    def span(self) -> tuple[float, float]:
        """First and last time of the paper's recording, s."""
        index = self.stores["main", self.horizons[0]].index
        return min(e["start"] for e in index), max(e["end"] for e in index)

    @property
    def step(self) -> float:
        """Sampling interval of the paper's recording, s."""
        return float(self.stores["main", self.horizons[0]].manifest["dt"])

    def folder(self, part: str, horizon: float) -> str:
        """Of the prepared sequences."""
        return str(self.stores[part, horizon].folder)

    @staticmethod
    def key(kind: str, scope: str, horizon: float, seed: int) -> str:
        """Of a calibration's task."""
        return f"fit-{kind}-{scope}-{horizon:g}s-{seed}"

    def fits(self, kind: str, scope: str, horizon: float) -> list[One]:
        """Calibrations from all starts, least training cost first."""
        found = []
        for seed in range(self.options.seed, self.options.seed + self.options.restarts):
            result = self.found.get(self.key(kind, scope, horizon, seed))
            if result is not None:
                found.append(One(kind, scope, horizon, seed, **result))
        return sorted(found, key=lambda one: one.J)

    def network(self, scope: str, horizon: float) -> One:
        """The network model of least training cost.

        The network of the walls alone is the model with people's network at zero: where that
        trains better, the search among both networks stopped at worse minima.
        """
        both = [*self.fits("nn", scope, horizon), *self.fits("wall", scope, horizon)]
        return min(both, key=lambda one: one.J)

    def chosen(self, model: str, scope: str, horizon: float) -> One:
        """The calibration that stands for a model, chosen by training cost."""
        return (
            self.network(scope, horizon) if model == "nn" else self.fits(model, scope, horizon)[0]
        )

    def all_costs(self, model: str, horizon: float) -> pd.Series:
        """Costs by sequence where all sequences trained, or of a baseline; m² s."""
        if model in MODELS:
            return pd.Series(self.chosen(model, ALL, horizon).train)
        return pd.Series(self.found[f"baselines-{horizon:g}s"]["costs"][model])

    def heldout(self, model: str, horizon: float) -> pd.Series:
        """Costs by sequence under models calibrated without its block of time, m² s."""
        if model not in MODELS:
            return self.all_costs(model, horizon)[self.heldout("sf", horizon).index]
        return pd.concat(
            pd.Series(self.chosen(model, scope, horizon).heldout) for scope in self.folds
        )

    def groups(self, horizon: float, names: Iterable[str]) -> np.ndarray:
        """Stretches of time that are resampled together."""
        every = sequences(self.folder("main", horizon))
        group = dict(zip((s.name for s in every), time_groups(every), strict=True))
        _, found = np.unique([group[name] for name in names], return_inverse=True)
        return found

    def compare(self, first: str, second: str, horizon: float) -> Paired:
        """Held-out costs of two models, by sequence."""
        a, b = self.heldout(first, horizon), self.heldout(second, horizon)
        group = self.groups(horizon, a.index)
        return paired(a.to_numpy(), b[a.index].to_numpy(), group, self.options.seed)

    def interval(self, costs: pd.Series, horizon: float) -> tuple[float, float]:
        """95 % interval of a mean cost, stretches of time resampled."""
        rng = np.random.default_rng(self.options.seed)
        means = group_weights(self.groups(horizon, costs.index), 2000, rng) @ costs.to_numpy()
        low, high = np.quantile(means, [0.025, 0.975])
        return float(low), float(high)

    def resampled(self, horizon: float) -> np.ndarray:
        """``(R, 3)`` A, k, kappa of refits to resampled stretches of time."""
        prefix = f"resample-{horizon:g}s-"
        chunks = sorted(
            (int(key.removeprefix(prefix)), value["rows"])
            for key, value in self.found.items()
            if key.startswith(prefix)
        )
        return np.array(
            [row for first, rows in chunks if first < self.options.bootstrap for row in rows]
        )

    def parameters(self) -> pd.DataFrame:
        """A, k, kappa by horizon with 95 % intervals, printed ones first."""
        rows: dict[str, dict[str, float]] = {"printed, 1 s": dict(printed.PARAMETERS)}
        for horizon in self.horizons:
            row = np.array(self.chosen("sf", ALL, horizon).row)
            ends = np.quantile(self.resampled(horizon), [0.025, 0.975], axis=0)
            rows[f"here, {horizon:g} s"] = {
                label: value
                for i, name in enumerate(NAMES)
                for label, value in (
                    (name, row[i]),
                    (f"{name}, low", ends[0, i]),
                    (f"{name}, high", ends[1, i]),
                )
            }
        table = pd.DataFrame(rows).T
        order = [f"{name}{end}" for name in NAMES for end in ("", ", low", ", high")]
        return table.reindex(columns=order)

    def by_horizon(self, *, heldout: bool) -> pd.DataFrame:
        """Mean cost of a sequence, a row per model or baseline, a column per horizon; m² s."""
        take = self.heldout if heldout else self.all_costs
        return pd.DataFrame(
            {
                f"{h:g} s": {LABELS[m]: float(take(m, h).mean()) for m in (*MODELS, *SIMPLE)}
                for h in self.horizons
            }
        )

    def blocks(self) -> pd.DataFrame:
        """Held-out cost of each block of time, m² s; rows by horizon and block."""
        rows = {}
        for horizon in self.horizons:
            every = {s.name: s for s in sequences(self.folder("main", horizon))}
            for number, scope in enumerate(self.folds, 1):
                held = {m: pd.Series(self.chosen(m, scope, horizon).heldout) for m in MODELS}
                names = held["sf"].index
                simple = self.all_costs("relaxation", horizon)[names]
                rows[(f"{horizon:g} s", f"{number}")] = {
                    "sequences": len(names),
                    "people": float(np.mean([every[name].n_agents for name in names])),
                    "speed": mean_speed(every[name] for name in names),
                    **{LABELS[m]: float(held[m].mean()) for m in MODELS},
                    LABELS["relaxation"]: float(simple.mean()),
                }
        table = pd.DataFrame(rows).T.rename_axis(["horizon", "block"])
        return table.astype({"sequences": int})

    def other_runs(self) -> pd.DataFrame:
        """Mean cost of a sequence in other runs; rows by horizon and run, m² s."""
        rows = {}
        for horizon in self.horizons:
            every = sequences(self.folder("others", horizon))
            for run, found in self.found[f"transfer-{horizon:g}s"].items():
                rows[(f"{horizon:g} s", run)] = {
                    "sequences": len(found["people"]),
                    "people": float(np.mean(found["people"])),
                    "speed": mean_speed(s for s in every if s.recording == run),
                    **{
                        LABELS[m]: float(np.mean(list(found["costs"][m].values())))
                        for m in (*MODELS, *SIMPLE[:3])
                    },
                }
        table = pd.DataFrame(rows).T.rename_axis(["horizon", "run"])
        return table.astype({"sequences": int})

    def every_parameter(self) -> pd.DataFrame:
        """All calibrations, one row per number: what is needed to compute their costs again."""
        rows = []
        for kind in KINDS:
            for scope in self.scopes:
                for horizon in self.horizons:
                    for one in self.fits(kind, scope, horizon):
                        values = named(KINDS[kind], one.row)
                        for name, value in values.items():
                            for place, number in np.ndenumerate(np.array(value)):
                                at = f"{name}{list(place)}" if place else name
                                rows.append((kind, scope, horizon, one.seed, at, float(number)))
        columns = ["model", "trained on", "horizon (s)", "start", "parameter", "value"]
        return pd.DataFrame(rows, columns=columns).set_index(columns[:4])
