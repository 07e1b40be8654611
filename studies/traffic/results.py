"""What the traffic study computed, as tables."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, cast

import numpy as np
import pandas as pd

from nnode.data.sequence import Sequence
from nnode.data.store import Store
from studies.options import TrafficStudyOptions
from studies.traffic import printed
from studies.traffic.problem import recording

#: Column of the mean over recordings.
AVERAGE = "average"
KMH = 3.6

ORDER = ("n2", "n4", "n10", "lin", "log")
NETWORKS = ("n2", "n4", "n10")
LAWS = ("lin", "log")


@dataclass
class Study:
    """Options, data and results of the traffic study."""

    options: TrafficStudyOptions
    stores: dict[str, Store]
    found: dict[str, dict[str, Any]]

    def recordings(self, policy: str = "keep") -> list[str]:
        """Recordings that have sequences under a policy, in the paper's order."""
        there = {entry["recording"] for entry in self.stores[policy].index}
        return [name for name in printed.RECORDINGS if name in there]

    def one(self, kind: str, name: str, model: str, policy: str = "keep") -> dict[str, Any]:
        """A task's result; ``model`` may end in ``-box``."""
        keyed = f"{kind}-{policy}" if kind in ("fit", "heldout") else kind
        return self.found[f"{keyed}-{name}-{model}"]

    def sequences(self, name: str, policy: str = "keep") -> list[Sequence]:
        """The sequences of a recording."""
        return recording(str(self.stores[policy].folder), name)

    def costs(self, kind: str = "fit", policy: str = "keep", suffix: str = "") -> pd.DataFrame:
        """Calibrated cost (m² s): a row per model, a column per recording, and the average.

        Held-out costs are means over the sequences, NaN where a recording has one group only.
        """
        names = self.recordings(policy)
        models = [m for m in ORDER if not suffix or m in NETWORKS]
        rows = {}
        for model in models:
            found = [self.one(kind, name, model + suffix, policy) for name in names]
            rows[model] = [_cost(one) for one in found]
        return averaged(pd.DataFrame(rows, index=names).T)

    def parameter(self, name: str, models: tuple[str, ...]) -> pd.DataFrame:
        """A scalar parameter of the best fits, a row per model, a column per recording."""
        names = self.recordings()
        return pd.DataFrame(
            {m: [self.one("fit", n, m)["parameters"][name] for n in names] for m in models},
            index=names,
        ).T

    def interval(self, name: str, models: tuple[str, ...]) -> tuple[pd.DataFrame, pd.DataFrame]:
        """Ends of the bootstrap intervals of a scalar parameter, laid out alike."""
        names = self.recordings()
        ends = [
            pd.DataFrame(
                {
                    m: [
                        np.quantile(self.one("fit", n, m)["bootstrap"]["values"][name], q)
                        for n in names
                    ]
                    for m in models
                },
                index=names,
            ).T
            for q in (0.025, 0.975)
        ]
        return ends[0], ends[1]

    def heldout(self, model: str, policy: str = "keep") -> tuple[np.ndarray, np.ndarray]:
        """Held-out cost (m² s) of every sequence of all recordings, and its group.

        ``model`` may also be ``no_interaction`` or ``constant_velocity``.
        """
        values, groups, first = [], [], 0
        plain = model in ("no_interaction", "constant_velocity")
        for name in self.recordings(policy):
            one = self.one("heldout", name, "lin" if plain else model, policy)
            if one["costs"] is None:
                continue
            values.append(one[model] if plain else one["costs"])
            groups.append(np.array(one["groups"]) + first)
            first += int(max(one["groups"])) + 1
        return np.concatenate([np.array(v, float) for v in values]), np.concatenate(groups)

    def parameters(self) -> pd.DataFrame:
        """Every calibrated run in long form: one row per number."""
        rows = []
        for key, one in self.found.items():
            if "parameters" not in one:
                continue
            kind = key.split("-")[0].replace("wider", "fit")
            faults = key.split("-")[1] if kind == "fit" else "keep"
            for name, value in one["parameters"].items():
                for index, number in np.ndenumerate(np.array(value)):
                    rows.append(
                        {
                            "optimizer": {"fit": "bfgs", "descent": "adadelta"}.get(kind, "cbo"),
                            "faults": faults,
                            "recording": one["recording"],
                            "model": one["model"],
                            "box": one.get("box"),
                            "parameter": name,
                            "index": " ".join(map(str, index)),
                            "value": float(number),
                            "J": one["cost"],
                        }
                    )
        return pd.DataFrame(rows)


def _cost(one: dict[str, Any]) -> float:
    if "cost" in one:
        return float(one["cost"])
    return float("nan") if one["costs"] is None else float(np.mean(one["costs"]))


def cell(table: pd.DataFrame, row: Any, column: str) -> float:
    """One number of a table."""
    return float(cast(Any, table.loc[row, column]))


def averaged(table: pd.DataFrame) -> pd.DataFrame:
    """The table with the mean over its columns."""
    return table.assign(**{AVERAGE: table.mean(axis=1)})


def least(table: pd.DataFrame) -> pd.DataFrame:
    """Which cells hold their column's least value."""
    return table.eq(table.min())


def printed_costs() -> pd.DataFrame:
    """Table (cost) of the paper, laid out as ours, with the averages as printed."""
    table = pd.DataFrame(printed.COSTS, index=list(printed.RECORDINGS)).T
    return table.assign(**{AVERAGE: pd.Series(printed.AVERAGE_COSTS)})


def printed_lengths() -> pd.DataFrame:
    """Table (length) of the paper, laid out as ours, with the averages as printed."""
    table = pd.DataFrame(printed.LENGTHS, index=list(printed.RECORDINGS)).T
    return table.assign(**{AVERAGE: pd.Series(printed.AVERAGE_LENGTHS)})
