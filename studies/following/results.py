"""Tables and figures of the study."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from operator import itemgetter
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from nnode.data.sequence import Sequence, collate
from nnode.data.store import Store
from nnode.model.system import System
from nnode.pages.replay import Scene
from nnode.plots.style import (
    FONT,
    GREY,
    OKABE_ITO,
    SMALL_FONT,
    curve_style,
    dress,
    legend_above,
    new_figure,
    thinned,
)
from studies.following import data, printed, stability
from studies.following.data import gap_of
from studies.following.tasks import EVERY, KINDS, OBJECTIVES, REFERENCE, costs_of, jackknifed
from studies.frame import by_number, by_unit, differences, versus
from studies.options import FollowingStudyOptions
from studies.replay import scenes

#: Speeds at which platoons are examined, m/s; the drawn speed, and the drawn period, s.
SPEEDS, SWING = (3.0, 6.0, 9.0, 12.0), (6.0, 60.0)
#: Nearly even driving: differences of speed, m/s, and accelerations, m/s², below these.
EVEN = (0.5, 0.2)
#: Laws in the figures of stability, beside the chosen one.
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

    @cached_property
    def calibrated(self) -> Any:
        """Cross-validated candidates by their held-out error: no test pair has a say in it."""
        results = self.of("cross_validate")
        error = results["heldout"].map(lambda costs: np.mean(costs["spacing"]))
        return results.loc[error.sort_values().index]

    @property
    def order(self) -> list[str]:
        """Names of these candidates."""
        return list(self.calibrated.index)

    @property
    def chosen(self) -> list[str]:
        """The reference, and the candidate of the least cross-validated error."""
        return list(dict.fromkeys((REFERENCE, self.order[0])))

    def heldout(self, objective: str = "spacing") -> pd.DataFrame:
        """Cross-validated costs of the training pairs, a column per candidate."""
        costs = self.calibrated["heldout"].map(itemgetter(objective))
        return by_unit(costs, self.calibrated.loc[REFERENCE, "clusters"])

    @property
    def tested(self) -> pd.DataFrame:
        """Costs of the test pairs, each a cluster of its own."""
        costs = self.of("tested")["costs"]
        return by_unit(costs, range(len(costs[REFERENCE])))

    def pairs(self, test: bool = False) -> tuple[Sequence, ...]:
        """Of one side of the published division."""
        return data.pairs(str(self.stores[data.PAIRS].folder), test)

    @cached_property
    def systems(self) -> dict[str, System]:
        """Candidates with their parameters from all training pairs."""
        batch, rows = collate(self.pairs()[:1]), self.of("cross_validate")["row"]
        return {
            name: costs_of(EVERY[name], batch).vector.fill_(np.array(row))
            for name, row in rows.items()
        }

    # -- laws --------------------------------------------------------------------------------

    @property
    def printed_errors(self) -> pd.Series[float]:
        """Published errors of the test pairs (m) by law and minimised objective."""
        return pd.DataFrame(printed.errors, index=printed.objectives).unstack()  # type: ignore[return-value]

    def published(self) -> pd.DataFrame:
        results, told = self.results.loc["reproduced-pairs"], self.printed_errors
        errors = [np.mean(results[f"{law} {objective}"]) for law, objective in told.index]
        table = pd.DataFrame({"printed": told, "here": errors}).rename_axis(["law", "minimised"])
        return table.assign(difference=table["here"] - table["printed"])

    def candidates(self) -> pd.DataFrame:
        table = versus(self.heldout(), REFERENCE, self.options.seed)
        table = table.rename(columns={"mean": "held out"}).drop(columns="p")
        table.insert(0, "train", self.calibrated["train"].map(np.mean))
        table.insert(0, "numbers", self.calibrated["row"].map(len))
        table["at a limit"] = self.calibrated["limits"].map(", ".join)
        return table

    def objectives_heldout(self) -> pd.DataFrame:
        costs = {label: self.heldout(objective).mean() for objective, label in OBJECTIVES.items()}
        return pd.DataFrame(costs).rename_axis("candidate")

    def test(self) -> pd.DataFrame:
        table = versus(self.tested[self.order], REFERENCE, self.options.seed)
        table = table.rename(columns={"mean": "test"}).drop(columns="better")
        table.insert(0, "held out", self.heldout().mean())
        told = self.printed_errors
        told.index = [f"{law}, printed ({objective})" for law, objective in told.index]
        return pd.concat([table, told.to_frame("test")]).rename_axis("candidate")

    def draw_candidates(self) -> Figure:
        costs = {
            "held out, clusters resampled": self.heldout(),
            "test, pairs resampled": self.tested,
        }
        pairs = [(name, REFERENCE) for name in self.order]
        away = {
            label: differences(table, pairs, self.options.seed) for label, table in costs.items()
        }
        return plot_errors(self.order, away, REFERENCE)

    def sides(self) -> pd.DataFrame:
        """Mean speed of the follower (m/s) and mean gap (m) of every pair, by side."""
        rows = [
            (side, np.mean(pair.velocity()[:, 0]), gap_of(pair).mean())
            for side in ("train", "test")
            for pair in self.pairs(side == "test")
        ]
        return pd.DataFrame(rows, columns=["side", "speed (m/s)", "gap (m)"])

    def draw_sides(self) -> Figure:
        return plot_sides(self.sides())

    def pairs_across(self) -> int:
        """Test pairs that share a vehicle with a training pair."""
        train = self.pairs()
        label = data.labels((*train, *self.pairs(test=True)))
        return int(np.isin(label[len(train) :], label[: len(train)]).sum())

    def standard_error(self, name: str, reference: str | None = None) -> float:
        """Of the mean error of the test pairs, or of its difference from another law, m."""
        error = self.tested[name] - (self.tested[reference] if reference else 0.0)
        return float(error.std() / np.sqrt(len(error)))

    def parameters(self) -> pd.DataFrame:
        order = list(dict.fromkeys((*self.chosen, *self.of("cross_validate").index)))
        fits = self.calibrated.loc[order, ["parameters"]].rename_axis("candidate").reset_index()
        return by_number(fits, "parameters").drop(columns="index")

    # -- one law -----------------------------------------------------------------------------

    def objectives_of(self, name: str) -> pd.DataFrame:
        rows = {}
        for objective, result in self.of("objectives").loc[name, list(OBJECTIVES)].items():
            shown = {k: v for k, v in result["parameters"].items() if not _weight(k)}
            limits = {"at a limit": ", ".join(result["limits"])}
            rows[objective] = {**result["reached"], **shown, **limits}
        return pd.DataFrame.from_dict(rows, orient="index").rename_axis("minimised")

    def precision(self, name: str) -> pd.DataFrame:
        result = self.of("precision").loc[name]
        row, half = np.array(result["row"]), np.array(result["half"])
        table = _by_parameter(
            result["names"],
            {"value": row, "from": row - half, "to": row + half, "unit": _units(result["names"])},
        )
        table["at a limit"] = table.index.isin(self.calibrated.loc[name, "limits"])
        for side, sign in (("below", -1), ("above", 1)):
            table[f"closed {side}"] = [
                _rises(profile, value, sign)
                for profile, value in zip(result["profiles"].values(), row, strict=True)
            ]
        if len(row) > MANY:
            return table
        return table.assign(
            **{f"r({n})": r for n, r in zip(table.index, result["correlation"], strict=True)}
        )

    def profiled(self, name: str) -> bool:
        """Whether the profiles of a candidate are drawn."""
        return len(self.calibrated.loc[name, "row"]) <= MANY

    def draw_profiles(self, name: str) -> Figure:
        result = self.of("precision").loc[name]
        best = dict(zip(result["names"], result["row"], strict=True))
        return plot_profiles(result["profiles"], best, printed.units)

    # -- drivers -----------------------------------------------------------------------------

    def drivers(self) -> pd.DataFrame:
        result = self.results.loc["halves"]
        costs = by_unit(result[["pooled", "alone", "shrunk"]], result["clusters"])
        table = versus(costs, "pooled", self.options.seed).drop(columns=["low", "high", "p"])
        table.insert(1, "median (m)", costs.median())
        return table.rename(columns={"mean": "second half (m)"}).rename_axis("calibrated")

    def spread(self) -> pd.DataFrame:
        result = self.results.loc["halves"]
        columns = {
            "pooled": result["centre"],
            "spread of single pairs": result["between"],
            "spread that lasts": result["spread"],
            "unit": _units(result["names"]),
        }
        return _by_parameter(result["names"], columns)

    # -- platoons ----------------------------------------------------------------------------

    def platoon_published(self) -> pd.DataFrame:
        results = self.results.loc["reproduced-platoon"]
        table = pd.DataFrame({"printed": printed.platoon_errors, "here": results["stopped"]})
        table["difference"] = table["here"] - table["printed"]
        table["the law alone"] = pd.Series(results["law"])
        table.loc["mean"] = table.mean()
        return table.rename_axis("follower")

    def platoon(self) -> pd.DataFrame:
        """Laws by the error inside the first 70 %, and the best law of each follower."""
        compared = self.of("compare")
        makes = compared["makes"].iloc[0]
        fold: Any
        heldout: Any
        fold, heldout = (
            pd.DataFrame(compared[part].to_list(), compared.index, makes)
            for part in ("chosen", "heldout")
        )
        table = pd.DataFrame(
            {
                "fold": fold.mean(axis=1),
                "first 70 %": compared["train"].map(np.mean),
                "last 30 %": heldout.mean(axis=1),
                **heldout,
                "at a limit": compared["limits"].map(lambda each: sum(map(len, each))),
            }
        ).sort_values("fold")
        best = {make: heldout.loc[law, make] for make, law in fold.idxmin().items()}
        for name, row in (("chosen by follower", best), ("ovm, printed", printed.platoon_errors)):
            table.loc[name] = pd.Series({"last 30 %": np.mean(list(row.values())), **row})
        table.loc["chosen by follower", "fold"] = fold.min().mean()
        return table.rename_axis("law")

    @cached_property
    def runs(self) -> pd.DataFrame:
        """Every follower of every run by itself."""
        result = self.results.loc["runs"]
        frame = pd.DataFrame({"run": result["runs"], "make": result["makes"]})
        frame["setting"] = pd.Series(result["settings"]).replace(SETTINGS)
        frame["error (m)"] = result["costs"]
        frame = frame.join(pd.DataFrame(result["parameters"]))
        return frame.assign(**{"at a limit": list(map(", ".join, result["limits"]))})

    @property
    def settings(self) -> list[str]:
        """Settings of the distance with which somebody drove."""
        return [setting for setting in SETTINGS.values() if setting in set(self.runs["setting"])]

    def time_gaps(self) -> pd.DataFrame:
        by = self.runs.groupby("setting")
        table = by["T"].agg(["count", "min", "median", "max"]).join(by["error (m)"].mean())
        return table.rename(columns={"count": "followers"}).loc[self.settings]

    def draw_time_gaps(self) -> Figure:
        return plot_time_gaps(self.runs, self.settings)

    # -- leaders -----------------------------------------------------------------------------

    def by_leader(self) -> pd.DataFrame:
        result = self.results.loc["leaders"]
        rows, without = (
            {kind: np.array(result[part][kind]) for kind in KINDS} for part in ("rows", "without")
        )
        columns: dict[str, Any] = {"unit": _units(result["names"])}
        for kind, row in rows.items():
            columns |= {kind: row, f"± {kind}": jackknifed(without[kind])}
        away = rows["CAV"] - rows["HV"]
        half = jackknifed(without["CAV"] - without["HV"])
        columns |= {"CAV minus HV": away, "from": away - half, "to": away + half}
        return _by_parameter(result["names"], columns)

    def leaders_heldout(self) -> pd.DataFrame:
        result = self.results.loc["leaders"]
        costs = by_unit(result["heldout"], result["clusters"])
        pairs = pd.DataFrame({"speed (m/s)": result["speed"], "gap (m)": result["gap"]})
        parts = {}
        for kind in KINDS:
            chosen = np.array(result["kinds"]) == kind
            table = versus(costs[chosen], "both", self.options.seed)
            table = table.rename(columns={"mean": "held out (m)"}).drop(columns=["p", "better"])
            means = pairs[chosen].mean()
            parts[f"behind {kind}"] = pd.concat(
                [pd.DataFrame({"pairs": chosen.sum(), **means}, index=table.index), table], axis=1
            )
        return pd.concat(parts, names=["pairs", "calibrated on"])

    # -- equilibria ----------------------------------------------------------------------------

    @cached_property
    def continuous(self) -> list[str]:
        """Candidates that have slopes; maps have none."""
        return [name for name in self.systems if not name.startswith(stability.MAPS)]

    @property
    def figured(self) -> list[str]:
        """Of these, those in the figures."""
        return [n for n in dict.fromkeys((*FIGURED, *self.chosen)) if n in self.continuous]

    @cached_property
    def length(self) -> float:
        """Mean length of the leaders, m."""
        return float(np.mean([p.length[1] for p in self.pairs() if p.length is not None]))

    def equilibria(self, speeds: Any, names: list[str]) -> pd.DataFrame:
        """Equilibrium gaps (m) by speed (m/s), a column per candidate."""
        gaps = {n: stability.equilibrium(self.systems[n], speeds, self.length) for n in names}
        return pd.DataFrame(gaps, index=pd.Index(speeds, name="speed (m/s)"))

    @cached_property
    def even_driving(self) -> pd.DataFrame:
        """Speed (m/s) and gap (m) of the samples of training pairs at nearly even driving."""
        parts = []
        for pair in self.pairs():
            v, lead = pair.velocity()[..., 0].T
            part = pd.DataFrame({"v": v, "gap": gap_of(pair)})
            even = (np.abs(v - lead) < EVEN[0]) & (np.abs(np.gradient(v, pair.dt)) < EVEN[1])
            parts.append(part[even])
        return pd.concat(parts, ignore_index=True)

    def equilibrium_gaps(self) -> pd.DataFrame:
        table = self.equilibria(SPEEDS, self.figured)
        v, gap = self.even_driving["v"], self.even_driving["gap"]
        for name, q in (
            ("measured, median", 0.5),
            ("quarter below", 0.25),
            ("quarter above", 0.75),
        ):
            table[name] = [gap[(v - speed).abs() < 0.5].quantile(q) for speed in SPEEDS]
        return table

    def draw_equilibria(self) -> Figure:
        samples = self.even_driving
        speeds = np.linspace(0.25, samples["v"].quantile(0.995), 60)
        return plot_equilibria(self.equilibria(speeds, self.figured), samples, self.length)

    @cached_property
    def slopes(self) -> dict[tuple[str, float], tuple[float, stability.Slopes]]:
        """Equilibrium gap, and slopes there, by candidate and speed; only where it exists."""
        gaps: Any = self.equilibria(SPEEDS, self.continuous)
        return {
            (name, v): (gap, stability.slopes(self.systems[name], gap, v, self.length))
            for name in gaps
            for v, gap in gaps[name].dropna().items()
        }

    def gain(self, name: str, speed: float, frequency: np.ndarray) -> np.ndarray:
        """The amplification of a disturbance by a follower at frequencies, 1/s."""
        lateness = stability.lateness(self.systems[name])
        return stability.passed(self.slopes[name, speed][1], frequency, **lateness)

    def string_stability(self) -> pd.DataFrame:
        table = pd.DataFrame(
            index=pd.Index(self.continuous, name="candidate"),
            columns=[f"{what} at {v:g} m/s" for v in SPEEDS for what in ("margin", "most")],
            dtype=float,
        )
        for (name, v), (_, slope) in self.slopes.items():
            table.loc[name, f"margin at {v:g} m/s"] = slope.margin
            most = self.gain(name, v, stability.FREQUENCIES).max()
            table.loc[name, f"most at {v:g} m/s"] = most
        return table

    def draw_amplification(self) -> Figure:
        speed, period = SWING
        w = 2 * np.pi / period
        gains, along = {}, {}
        for name in self.continuous:
            if name in self.figured and (name, speed) in self.slopes:
                gap, system = self.slopes[name, speed][0], self.systems[name]
                gains[name] = self.gain(name, speed, stability.FREQUENCIES)
                swing = stability.platoon(system, speed, gap, self.length, w)
                theory = float(self.gain(name, speed, np.array([w]))[0])
                along[name] = (swing / swing[0], theory ** np.arange(len(swing)))
        return plot_amplification(gains, stability.FREQUENCIES, along)

    def scenes(self) -> list[Scene]:
        """Test pairs of the player."""
        systems = {name: self.systems[name] for name in self.chosen}
        return scenes(thinned(self.pairs(test=True), FEW), systems)


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


#: Rises of the error up to this are shown, m: beyond it no value is in question.
SHOWN = 0.6

_BLUE, _RED = OKABE_ITO["blue"], OKABE_ITO["vermillion"]


def plot_errors(names: list[str], away: Mapping[str, pd.DataFrame], reference: str) -> Figure:
    """Differences of candidates to a reference, with intervals, one row per candidate.

    Args:
        names: from top to bottom.
        away: what was compared on to ``difference``, ``low`` and ``high`` (m) by candidate.
    """
    figure = new_figure(7.2, 0.24 * len(names) + 1.1)
    ax = figure.subplots()
    place = np.arange(len(names))[::-1]
    handles = []
    for i, (label, table) in enumerate(away.items()):
        style = curve_style(i)
        y = place + (0.5 - i) * 0.3
        ax.hlines(y, table["low"], table["high"], color=style["color"], linewidth=1.4)
        ax.plot(table["difference"], y, style["marker"], color=style["color"], markersize=4)
        handles.append(Line2D([], [], **{**style, "linestyle": "-"}, markersize=4, label=label))
    ax.axvline(0, color=GREY, linewidth=0.8)
    ax.set_yticks(place, names)
    ax.set_ylim(-0.8, len(names) - 0.2)
    # one that blows up on a few pairs must not hide the others
    ends = pd.concat(away)[["low", "high"]].abs()
    limit = 1.15 * float(np.nanquantile(ends, 0.9))
    ax.set_xlim(-limit, limit)
    dress(ax, x=f"error minus that of {reference} (m)")
    legend_above(figure, handles, columns=2)
    return figure


def plot_sides(pairs: pd.DataFrame) -> Figure:
    """Mean speed (m/s) and mean gap (m) of the pairs by ``side`` of a division."""
    figure = new_figure(5.2, 3.4)
    ax = figure.subplots()
    for i, (name, part) in enumerate(pairs.groupby("side", sort=False)):
        style = curve_style(i)
        ax.plot(
            part["speed (m/s)"],
            part["gap (m)"],
            style["marker"],
            color=style["color"],
            markerfacecolor="none" if i == 0 else style["color"],
            markersize=5,
            label=f"{name}: {len(part)} pairs",
        )
    dress(ax, x="mean speed of the follower (m/s)", y="mean gap (m)")
    ax.legend(fontsize=SMALL_FONT, frameon=False)
    return figure


def plot_profiles(
    points: Mapping[str, Mapping[str, list[float]]],
    best: Mapping[str, float],
    units: Mapping[str, str],
) -> Figure:
    """The rise of the cost where one parameter is held and all others are calibrated again.

    Args:
        points: parameter to ``values``, ``rise``, ``low`` and ``high`` (m).
    """
    figure = new_figure(2.1 * len(points), 2.5)
    axes = figure.subplots(1, len(points), sharey=True, squeeze=False)[0]
    for ax, (name, profile) in zip(axes, points.items(), strict=True):
        ax.fill_between(
            profile["values"], profile["low"], profile["high"], color=_BLUE, alpha=0.15, lw=0
        )
        ax.plot(profile["values"], profile["rise"], "o-", color=_BLUE, markersize=3, linewidth=1.2)
        ax.axhline(0, color=GREY, linewidth=0.8)
        ax.axvline(best[name], color=_RED, linewidth=0.9, linestyle=(0, (4, 2)))
        dress(ax, x=f"{name} ({units.get(name, '')})")
        ax.set_xscale("log")
        ax.minorticks_off()
        low, high = min(profile["values"]), max(profile["values"])
        ticks = [t for t in (0.25, 0.5, 1, 2, 5, 10, 20, 50, 100) if low <= t <= high]
        ax.set_xticks(ticks, [f"{t:g}" for t in ticks])
    axes[0].set_ylabel("rise of the error (m)", fontsize=FONT)
    axes[0].set_ylim(-0.1 * SHOWN, SHOWN)
    return figure


def plot_equilibria(gaps: pd.DataFrame, measured: pd.DataFrame, length: float) -> Figure:
    """Equilibrium gap by speed, and flow by density, of laws over nearly even driving.

    Args:
        gaps: equilibrium gaps (m), a column per law, indexed by speed (m/s).
        measured: samples at nearly even driving: speed ``v`` (m/s) and ``gap`` (m).
        length: of a vehicle, m.
    """
    figure = new_figure(8.6, 3.5)
    left, right = figure.subplots(1, 2)
    speeds, v, s = gaps.index.to_numpy(), measured["v"], measured["gap"]
    for ax, x, y in ((left, v, s), (right, 1e3 / (s + length), 3.6e3 * v / (s + length))):
        ax.plot(x, y, ".", color=GREY, markersize=1.5, alpha=0.25, rasterized=True)
    for i, (name, gap) in enumerate(gaps.items()):
        style = {**curve_style(i), "marker": "", "linewidth": 1.5}
        left.plot(speeds, gap, **style, label=name)
        right.plot(1e3 / (gap + length), 3.6e3 * speeds / (gap + length), **style)
    left.set(xlim=(0, speeds.max()), ylim=(0, s.quantile(0.998)))
    right.set(xlim=(0, 180), ylim=(0, 3000))
    dress(left, x="speed (m/s)", y="gap (m)")
    dress(right, x="density (vehicles/km)", y="flow (vehicles/h)")
    left.legend(fontsize=SMALL_FONT, loc="upper left")
    return figure


def plot_amplification(
    gains: Mapping[str, np.ndarray],
    frequency: np.ndarray,
    along: Mapping[str, tuple[np.ndarray, np.ndarray]],
) -> Figure:
    """How much of a swing one follower passes on, and what it comes to along a platoon.

    Args:
        gains: law to |G| at frequencies (1/s).
        along: law to simulated amplitudes by place, over the leader's, and what |G| says.
    """
    figure = new_figure(8.6, 3.3)
    left, right = figure.subplots(1, 2)
    for i, (name, gain) in enumerate(gains.items()):
        style = {**curve_style(i), "marker": "", "linewidth": 1.4}
        left.plot(2 * np.pi / frequency, gain, **style, label=name)
    left.axhline(1, color=GREY, linewidth=0.8)
    left.set(xscale="log", xlim=(3, 200), ylim=(0, None))
    dress(left, x="period of the swing (s)", y="swing of the follower over the leader's")
    left.legend(fontsize=SMALL_FONT)
    for i, (simulated, theory) in enumerate(along.values()):
        style = curve_style(i)
        place = np.arange(len(simulated))
        right.plot(place, theory, color=style["color"], linewidth=1.2, linestyle=style["linestyle"])
        right.plot(place, simulated, style["marker"], color=style["color"], markersize=4)
    dress(right, x="place behind the leader", y="swing over the leader's")
    kinds = [
        Line2D([], [], color=GREY, linewidth=1.2, label="linear theory"),
        Line2D([], [], color=GREY, marker="o", linestyle="", markersize=4, label="simulated"),
    ]
    right.legend(handles=kinds, fontsize=SMALL_FONT)
    return figure


def plot_time_gaps(followers: pd.DataFrame, settings: list[str]) -> Figure:
    """Time gap ``T`` (s) of each follower, by ``setting`` along the axis and ``make`` within it."""
    place = followers["setting"].map({name: i for i, name in enumerate(settings)})
    followers = followers.assign(place=place).dropna(subset="place")
    figure = new_figure(6.4, 3.2)
    ax = figure.subplots()
    makes = followers.sort_values(["place", "make"])["make"].unique()
    for i, make in enumerate(makes):
        part = followers[followers["make"] == make]
        style = {**curve_style(i), "linestyle": "", "fillstyle": "none", "markersize": 5}
        shift = (i - (len(makes) - 1) / 2) * 0.16
        ax.plot(part["place"] + shift, part["T"], **style, label=make)
    ax.set_xticks(range(len(settings)), settings)
    dress(ax, y="time gap T (s)")
    ax.legend(fontsize=SMALL_FONT)
    ax.set_ylim(bottom=0)
    return figure
