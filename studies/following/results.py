"""Tables and figures of the study of car following."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from operator import itemgetter
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from nnode.data.sequence import Sequence, collate
from nnode.data.store import Store
from nnode.model.system import System
from nnode.pages.replay import ReplayBlock
from nnode.plots.style import thinned
from studies.following import data, figures, leaders, printed, stability
from studies.following.candidates import DECAY, EVERY, REFERENCE, key
from studies.following.data import gap_of
from studies.following.fit import OBJECTIVES, costs_of
from studies.frame import by_number, by_unit, differences, labelled, versus
from studies.options import FollowingStudyOptions
from studies.replay import player, scenes

#: Objectives on a page.
WITH_UNITS = {
    "spacing": "gap, RMSE (m)",
    "gap": "gap, MSE (m²)",
    "relative_gap": "relative gap, MSE",
    "log_gap": "log of the gap, MSE",
    "speed": "speed, MSE (m²/s²)",
}
#: Speeds at which platoons are looked at, m/s; the speed, and the period (s) of a swing, drawn.
SPEEDS, SWING = (3.0, 6.0, 9.0, 12.0), (6.0, 60.0)
#: Nearly even driving: differences of speed, m/s, and accelerations, m/s², below these.
EVEN = (0.5, 0.2)
#: Laws in the figures of stability, where they are there, beside the chosen one.
FIGURED = ("idm", "ovm", "fvdm", "gipps", "helly")
#: Settings of the distance in their order; people drive without.
SETTINGS = {"min": "ACC, min", "max": "ACC, max", "none": "people"}
#: Parameters up to which their profiles and correlations are shown.
MANY = 8
#: Pairs in the player.
FEW = 10


@dataclass
class Study:
    """Options, prepared data, and a row of results per task, by its key."""

    options: FollowingStudyOptions
    stores: dict[str, Store]
    results: Any

    def of(self, task: str) -> Any:
        """The results of a function that many candidates are given to, a row per candidate."""
        return self.results.query("task == @task").set_index("name")

    @property
    def names(self) -> list[str]:
        """Candidates that were cross-validated."""
        return list(self.of("cross_validate").index)

    @cached_property
    def order(self) -> list[str]:
        """Candidates by cross-validated error: no test pair has a say in it."""
        return list(self.heldout().mean().sort_values().index)

    @property
    def chosen(self) -> list[str]:
        """The reference, and the candidate of the least cross-validated error."""
        return list(dict.fromkeys((REFERENCE, self.order[0])))

    def heldout(self, objective: str = "spacing") -> pd.DataFrame:
        """Cross-validated costs of the training pairs, a column per candidate."""
        one = self.of("cross_validate")
        return by_unit(one["heldout"].map(itemgetter(objective)), one.loc[REFERENCE, "clusters"])

    def tested(self) -> pd.DataFrame:
        """Costs of the test pairs, each a cluster of its own."""
        costs = self.of("tested")["spacing"]
        return by_unit(costs, range(len(costs[REFERENCE])))

    def away(self, costs: pd.DataFrame) -> pd.DataFrame:
        """All candidates minus the reference."""
        pairs = [(name, REFERENCE) for name in self.order]
        return differences(costs, pairs, self.options.seed).droplevel("second")

    def pairs(self, test: bool = False) -> tuple[Sequence, ...]:
        """Of one side of the published division."""
        return data.pairs(str(self.stores[data.PAIRS].folder), test)

    def system(self, name: str) -> System:
        """A candidate with its parameters from all training pairs."""
        row = self.of("cross_validate").loc[name, "row"]
        return costs_of(EVERY[name], collate(self.pairs()[:1])).vector.fill_(np.array(row))

    # -- tables ------------------------------------------------------------------------------

    def tables(self) -> dict[str, pd.DataFrame]:
        """By their names in the template."""
        objectives = {label: self.heldout(o).mean() for o, label in WITH_UNITS.items()}
        by_name = {
            "published": self._published(),
            "candidates": self._candidates(),
            "objectives_heldout": pd.DataFrame(objectives).loc[self.order].rename_axis("candidate"),
            "test": self._test(),
            "sides": self._sides().groupby("side", sort=False).mean(),
            "equilibrium_gaps": self._equilibrium_gaps(),
            "stability": self._stability(),
            "drivers": self._drivers(),
            "spread": self._spread(),
            "platoon_published": self._platoon_published(),
            "platoon": self._platoon(),
            "time_gaps": self._time_gaps(),
            "runs": self._runs(),
            "leaders": self._leaders(),
            "leaders_heldout": self._leaders_heldout(),
            "parameters": self._parameters(),
        }
        for name in self.chosen:
            by_name[f"objectives_{key(name)}"] = self._objectives(name)
            by_name[f"precision_{key(name)}"] = self._precision(name)
        return by_name

    def _published(self) -> pd.DataFrame:
        here = self.results.loc["reproduced-pairs"]
        rows = {
            (law, objective): {"printed": told, "here": float(np.mean(here[f"{law} {objective}"]))}
            for law, errors in printed.errors.items()
            for objective, told in zip(printed.objectives, errors, strict=True)
        }
        table = labelled(rows, "law", "minimised")
        return table.assign(difference=table["here"] - table["printed"])

    def _candidates(self) -> pd.DataFrame:
        one = self.of("cross_validate").loc[self.order]
        table = versus(self.heldout(), REFERENCE, self.options.seed).loc[self.order]
        table = table.rename(columns={"mean": "held out"}).drop(columns="p")
        table.insert(0, "train", one["train"].map(lambda costs: np.mean(costs["spacing"])))
        table.insert(0, "numbers", one["row"].map(len))
        return table.assign(**{"at a limit": one["limits"].map(", ".join)})

    def _test(self) -> pd.DataFrame:
        table = versus(self.tested(), REFERENCE, self.options.seed).loc[self.order]
        table = table.rename(columns={"mean": "test"}).drop(columns="better")
        table.insert(0, "held out", self.heldout().mean())
        told = {
            f"{law}, printed ({objective})": {"test": value}
            for law, errors in printed.errors.items()
            for objective, value in zip(printed.objectives, errors, strict=True)
        }
        table = pd.concat([table, pd.DataFrame.from_dict(told, orient="index")])
        return table.rename_axis("candidate")

    def _sides(self) -> pd.DataFrame:
        """Mean speed of the follower (m/s) and mean gap (m) of every pair, by side."""
        rows = [
            (side, float(np.mean(pair.velocity()[:, 0])), float(gap_of(pair).mean()))
            for side in ("train", "test")
            for pair in self.pairs(side == "test")
        ]
        return pd.DataFrame(rows, columns=["side", "speed (m/s)", "gap (m)"])

    def _objectives(self, name: str) -> pd.DataFrame:
        rows = {}
        for objective, one in self.of("objectives").loc[name, list(OBJECTIVES)].items():
            shown = {k: v for k, v in one["parameters"].items() if not _weight(k)}
            limits = {"at a limit": ", ".join(one["limits"])}
            rows[objective] = {**one["reached"], **shown, **limits}
        return pd.DataFrame.from_dict(rows, orient="index").rename_axis("minimised")

    def _precision(self, name: str) -> pd.DataFrame:
        one = self.of("precision").loc[name]
        names, row, half = one["names"], np.array(one["row"]), np.array(one["half"])
        limits = self.of("cross_validate").loc[name, "limits"]
        table = _by_parameter(
            names,
            {
                "value": row,
                "from": row - half,
                "to": row + half,
                "unit": _units(names),
                "at a limit": [n in limits for n in names],
            },
        )
        for side, sign in (("below", -1), ("above", 1)):
            closed = [_rises(one["profiles"][n], v, sign) for n, v in zip(names, row, strict=True)]
            table[f"closed {side}"] = closed
        if len(names) > MANY:
            return table
        correlation = dict(zip((f"r({n})" for n in names), one["correlation"], strict=True))
        return table.assign(**correlation)

    def _equilibrium_gaps(self) -> pd.DataFrame:
        v, s = self._even_driving
        gaps = {
            n: stability.equilibrium(self.systems[n], np.array(SPEEDS), self.length)
            for n in self.figured
        }
        measured = [pd.Series(s[np.abs(v - x) < 0.5]) for x in SPEEDS]
        quarters = {"measured, median": 0.5, "quarter below": 0.25, "quarter above": 0.75}
        gaps |= {
            name: np.array([each.quantile(q) for each in measured]) for name, q in quarters.items()
        }
        return pd.DataFrame(gaps, index=pd.Index(SPEEDS, name="speed (m/s)"))

    def _stability(self) -> pd.DataFrame:
        rows: dict[str, dict[str, float]] = {name: {} for name in self.systems}
        for name, v, _, slope in self._slopes():
            gain = stability.passed(
                slope, stability.FREQUENCIES, **stability.lateness(self.systems[name])
            )
            rows[name][f"margin at {v:g} m/s"] = slope.margin
            rows[name][f"most at {v:g} m/s"] = float(gain.max())
        columns = [f"{what} at {v:g} m/s" for v in SPEEDS for what in ("margin", "most")]
        return pd.DataFrame(rows, index=columns, dtype=float).T.rename_axis("candidate")

    def _drivers(self) -> pd.DataFrame:
        one = self.results.loc["halves"]
        costs = by_unit(one[["pooled", "alone", "shrunk"]], one["clusters"])
        table = versus(costs, "pooled", self.options.seed).drop(columns=["low", "high", "p"])
        table.insert(1, "median (m)", costs.median())
        return table.rename(columns={"mean": "second half (m)"}).rename_axis("calibrated")

    def _spread(self) -> pd.DataFrame:
        one = self.results.loc["halves"]
        return _by_parameter(
            one["names"],
            {
                "pooled": one["centre"],
                "spread of single pairs": one["between"],
                "spread that lasts": one["spread"],
                "unit": _units(one["names"]),
            },
        )

    def _platoon_published(self) -> pd.DataFrame:
        again = self.results.loc["reproduced-platoon"]
        table = pd.DataFrame({"printed": printed.platoon_errors, "here": again["stopped"]})
        table["difference"] = table["here"] - table["printed"]
        table["the law alone"] = pd.Series(again["law"])
        table.loc["mean"] = table.mean()
        return table.rename_axis("follower")

    def _platoon(self) -> pd.DataFrame:
        """Laws by the error inside the first 70 %, and the best law of each follower."""
        compared = self.of("compare")
        makes = compared["makes"].iloc[0]
        fold: Any
        held: Any
        fold, held = (
            pd.DataFrame(compared[part].to_list(), compared.index, makes)
            for part in ("chosen", "heldout")
        )
        table = pd.DataFrame(
            {
                "fold": fold.mean(axis=1),
                "first 70 %": compared["train"].map(np.mean),
                "last 30 %": held.mean(axis=1),
                **held,
                "at a limit": compared["limits"].map(lambda each: sum(map(len, each))),
            }
        )
        best = pd.Series({make: held.loc[law, make] for make, law in fold.idxmin().items()})
        told = pd.Series(printed.platoon_errors)
        more = {
            "chosen by follower": {"fold": fold.min().mean(), "last 30 %": best.mean(), **best},
            "ovm, printed": {"last 30 %": told.mean(), **told},
        }
        table = pd.concat([table.sort_values("fold"), pd.DataFrame.from_dict(more, orient="index")])
        return table.rename_axis("law")

    def _runs(self) -> pd.DataFrame:
        """Every follower of every run by itself."""
        one = self.results.loc["runs"]
        frame = pd.DataFrame({"run": one["runs"], "make": one["makes"]})
        frame["setting"] = [SETTINGS.get(s, s) for s in one["settings"]]
        frame["error (m)"] = one["costs"]
        limits = [", ".join(names) for names in one["limits"]]
        return frame.join(pd.DataFrame(one["parameters"])).assign(**{"at a limit": limits})

    def _time_gaps(self) -> pd.DataFrame:
        by = self._runs().groupby("setting")
        table = by["T"].agg(["count", "min", "median", "max"]).join(by["error (m)"].mean())
        return table.rename(columns={"count": "followers"}).loc[self._settings]

    @property
    def _settings(self) -> list[str]:
        measured = set(self._runs()["setting"])
        return [setting for setting in SETTINGS.values() if setting in measured]

    def _leaders(self) -> pd.DataFrame:
        one = self.results.loc["leaders"]
        rows, without = (
            {kind: np.array(one[part][kind]) for kind in leaders.KINDS}
            for part in ("rows", "without")
        )
        columns: dict[str, Any] = {"unit": _units(one["names"])}
        for kind, row in rows.items():
            columns |= {kind: row, f"± {kind}": leaders.jackknifed(without[kind])}
        away = rows["CAV"] - rows["HV"]
        half = leaders.jackknifed(without["CAV"] - without["HV"])
        columns |= {"CAV minus HV": away, "from": away - half, "to": away + half}
        return _by_parameter(one["names"], columns)

    def _leaders_heldout(self) -> pd.DataFrame:
        one = self.results.loc["leaders"]
        costs = by_unit(one["heldout"], one["clusters"])
        parts = {}
        for kind in leaders.KINDS:
            chosen = np.array(one["kinds"]) == kind
            table = versus(costs[chosen], "both", self.options.seed)
            table = table.rename(columns={"mean": "held out (m)"}).drop(columns=["p", "better"])
            for name, what in (("gap (m)", "gap"), ("speed (m/s)", "speed")):
                table.insert(0, name, float(np.array(one[what])[chosen].mean()))
            table.insert(0, "pairs", int(chosen.sum()))
            parts[f"behind {kind}"] = table
        return pd.concat(parts, names=["pairs", "calibrated on"])

    def _parameters(self) -> pd.DataFrame:
        order = list(dict.fromkeys((*self.chosen, *self.names)))
        fits = self.of("cross_validate").loc[order, ["parameters"]].rename_axis("candidate")
        return by_number(fits.reset_index(), "parameters").drop(columns="index")

    # -- equilibria ----------------------------------------------------------------------------

    @cached_property
    def systems(self) -> dict[str, System]:
        """Calibrated laws that have slopes; maps have none."""
        names = [n for n in self.names if not n.startswith(stability.MAPS)]
        return {name: self.system(name) for name in names}

    @property
    def figured(self) -> list[str]:
        """Of these, those in the figures."""
        return [n for n in dict.fromkeys((*FIGURED, *self.chosen)) if n in self.systems]

    @property
    def length(self) -> float:
        """Mean length of the leaders, m."""
        return float(np.mean([p.length[1] for p in self.pairs() if p.length is not None]))

    @cached_property
    def _even_driving(self) -> tuple[np.ndarray, np.ndarray]:
        """Speeds and gaps of training pairs at nearly even driving."""
        speeds, gaps = [], []
        for pair in self.pairs():
            v = pair.velocity()[..., 0]
            even = np.abs(v[:, 0] - v[:, 1]) < EVEN[0]
            even &= np.abs(np.gradient(v[:, 0], pair.dt)) < EVEN[1]
            speeds.append(v[even, 0])
            gaps.append(gap_of(pair)[even])
        return np.concatenate(speeds), np.concatenate(gaps)

    def _slopes(self) -> Iterable[tuple[str, float, float, stability.Slopes]]:
        """Candidate, speed, equilibrium gap and slopes there, where there is an equilibrium."""
        for name, system in self.systems.items():
            gaps = stability.equilibrium(system, np.array(SPEEDS), self.length)
            for v, gap in zip(SPEEDS, map(float, gaps), strict=True):
                if np.isfinite(gap):
                    yield name, v, gap, stability.slopes(system, gap, v, self.length)

    # -- figures -----------------------------------------------------------------------------

    def figures(self) -> dict[str, Figure | ReplayBlock]:
        """By their names in the template."""
        away = {
            "held out, clusters resampled": self.away(self.heldout()),
            "test, pairs resampled": self.away(self.tested()),
        }
        v = self._even_driving[0]
        speeds = np.linspace(0.25, float(np.quantile(v, 0.995)), 60)
        curves = {
            n: stability.equilibrium(self.systems[n], speeds, self.length) for n in self.figured
        }
        drawings: dict[str, Figure | ReplayBlock] = {
            "candidates": figures.errors(self.order, away, REFERENCE),
            "sides": figures.sides(self._sides()),
            "equilibria": figures.equilibria(speeds, curves, self._even_driving, self.length),
            "amplification": self._amplification(),
            "time_gaps": figures.time_gaps(self._runs(), self._settings),
            "replay": self._replay(),
        }
        for name in self.profiled:
            one = self.of("precision").loc[name]
            best = dict(zip(one["names"], one["row"], strict=True))
            drawings[f"profiles_{key(name)}"] = figures.profiles(
                one["profiles"], best, printed.units
            )
        return drawings

    @property
    def profiled(self) -> list[str]:
        """Candidates whose profiles are drawn."""
        return [n for n in self.chosen if len(self.of("precision").loc[n, "names"]) <= MANY]

    def _amplification(self) -> Figure:
        speed, period = SWING
        gains, along = {}, {}
        for name, v, gap, slope in self._slopes():
            if v != speed or name not in self.figured:
                continue
            system, w = self.systems[name], 2 * np.pi / period
            late = stability.lateness(system)
            gains[name] = stability.passed(slope, stability.FREQUENCIES, **late)
            swing = stability.platoon(system, v, gap, self.length, w)
            theory = float(stability.passed(slope, np.array([w]), **late)[0])
            along[name] = (swing / swing[0], theory ** np.arange(len(swing)))
        return figures.amplification(gains, stability.FREQUENCIES, along)

    def _replay(self) -> ReplayBlock:
        pairs = self.pairs(test=True)
        systems = {name: self.system(name) for name in self.chosen}
        what = (
            f"Test pairs with the measured leader, as measured and as simulated by "
            f"{' and '.join(systems)}, which are calibrated to all training pairs."
        )
        return player(scenes(thinned(pairs, FEW), systems), what, len(pairs))

    def values(self) -> dict[str, Any]:
        """What else the template refers to."""
        train, test = self.pairs(), self.pairs(test=True)
        label = data.labels((*train, *test))
        floor = self.results.loc["floor"]
        tested = self.tested()
        paired = (tested[self.order[0]] - tested[REFERENCE]).std() / np.sqrt(len(tested))
        return {
            "options": self.options,
            "reference": REFERENCE,
            "best": self.order[0],
            "keys": {name: key(name) for name in self.chosen},
            "profiled": self.profiled,
            "left": [name for name in EVERY if name not in self.names],
            "pairs": len(train),
            "tests": len(test),
            "clusters": len(set(self.of("cross_validate").loc[REFERENCE, "clusters"])),
            "shared": int(np.isin(label[len(train) :], label[: len(train)]).sum()),
            "half": 1.96 * float(tested[REFERENCE].std() / np.sqrt(len(tested))),
            "seen": 2.8 * float(paired),
            "decay": DECAY,
            "floor": float(np.mean(floor["costs"])),
            "touched": sum(map(bool, floor["limits"])),
            "strengths": sorted(set(self.results.loc["halves", "strengths"])),
            "even": EVEN,
            "length": self.length,
            "swing": SWING,
            "objectives": list(OBJECTIVES),
            "run": printed.platoon,
        }


def _units(names: list[str]) -> list[str]:
    """The units of parameters; 1 where there is none."""
    return [printed.units.get(name, "1") for name in names]


def _by_parameter(names: list[str], columns: dict[str, Any]) -> pd.DataFrame:
    return pd.DataFrame(columns, index=pd.Index(names, name="parameter"))


def _weight(name: str) -> bool:
    """Whether a parameter is a weight of a network."""
    return name.startswith("n") and name[1:2].isdigit()


def _rises(profile: dict[str, list[float]], best: float, side: int) -> bool:
    """Whether the error rises beyond doubt on a side of the best value within the profile."""
    values, low = np.array(profile["values"]), np.array(profile["low"])
    return bool((low[side * (values - best) > 0] > 0).any())
