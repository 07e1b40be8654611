"""Tables and figures of the study."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations
from operator import itemgetter
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from nnode.calibrate.resampling import average_interval, holm
from nnode.data.sequence import Sequence
from nnode.data.store import Store
from nnode.pages.replay import Scene
from nnode.plots.style import (
    GREY,
    SMALL_FONT,
    curve_style,
    dress,
    legend_above,
    new_figure,
    thinned,
)
from nnode.plots.traffic import measured_gaps
from studies.figures import error_bars
from studies.frame import by_number, by_unit, differences
from studies.options import TrafficStudyOptions
from studies.replay import scenes
from studies.traffic import printed
from studies.traffic.tasks import BASELINES, GAPS, recording, system_of

LAWS, NETWORKS = ("lin", "log"), ("n2", "n4", "n10")
MODELS = (*NETWORKS, *LAWS)
AVERAGE, KMH = "average", 3.6
#: Sequences named per recording, and the models whose costs are taken apart.
NAMED, SPLIT = 3, ("lin", "n4")
#: Models in the player, and how many sequences of each recording.
SHOWN, FEW = ("lin", "n2"), 4
#: A cost gradient takes the time of about so many simulations, which the figure counts.
GRADIENT = 3


def averaged(table: Any) -> Any:
    """The table with the mean over its columns."""
    return table.assign(**{AVERAGE: table.mean(axis=1)})


def as_printed(table: dict[str, Any], averages: dict[str, float]) -> Any:
    """A table of the paper: a row per model, a column per recording, the averages as printed."""
    rows = pd.DataFrame(table, index=list(printed.recordings)).T
    return rows.assign(**{AVERAGE: pd.Series(averages)})


def side_by_side(ours: Any, theirs: Any) -> Any:
    """Our rows, the printed ones and the differences, one under the other by model."""
    theirs = theirs.loc[ours.index, ours.columns]
    parts = {"here": ours, "printed": theirs, "difference": ours - theirs}
    stacked = pd.concat(parts, names=["", "model"]).swaplevel()
    return stacked.reindex([(model, part) for model in ours.index for part in parts])


@dataclass
class Study:
    """Options, prepared data by treatment of faults, and a row of results per task."""

    options: TrafficStudyOptions
    stores: dict[str, Store]
    results: Any

    def __post_init__(self) -> None:
        policy = {str(store.folder): name for name, store in self.stores.items()}
        boxed = self.results["box"].notna()
        self.results = self.results.assign(
            faults=self.results["folder"].map(policy),
            recording=self.results["recording_name"],
            boxed=boxed,
            law=self.results["model"] + np.where(boxed, "-box", ""),
        )

    def take(self, value: str, task: str = "fit", faults: str = "keep", box: bool = False) -> Any:
        """One result of every task of a kind: a row per model, a column per recording."""
        chosen = self.results.query("task == @task and faults == @faults and boxed == @box")
        pivoted = chosen.pivot(index="model", columns="recording", values=value)
        rows = [m for m in MODELS if m in pivoted.index]
        return pivoted.loc[rows, [r for r in printed.recordings if r in pivoted.columns]]

    def costs(self, task: str = "fit", faults: str = "keep", box: bool = False) -> Any:
        """Calibrated cost (m² s), and the average over recordings."""
        return averaged(self.take("cost", task, faults, box).astype(float))

    def parameter(self, name: str, models: tuple[str, ...] = MODELS) -> Any:
        """A scalar parameter of the best fits, and both ends of its bootstrap interval."""
        values = self.take("parameters").loc[list(models)].map(itemgetter(name))
        drawn = self.take("bootstrap").loc[list(models)].map(lambda b: b["values"][name])
        return values, *(drawn.map(np.quantile, q=q) for q in (0.025, 0.975))

    def recording(self, name: str, faults: str = "keep") -> list[Sequence]:
        """The sequences of a recording."""
        return recording(str(self.stores[faults].folder), name)

    @cached_property
    def heldout(self) -> dict[str, pd.DataFrame]:
        """By treatment of faults, a column of held-out costs (m² s) per model and baseline."""
        every = self.results.query("task == 'cross_validate'").dropna(subset="groups")
        every = every.explode(["costs", "groups", *BASELINES])
        by_faults = {}
        for faults, part in every.groupby("faults"):
            columns = {str(law): rows["costs"] for law, rows in part.groupby("law", sort=False)}
            lin = part[part["law"] == "lin"]
            columns |= {name: lin[name] for name in BASELINES}
            by_faults[str(faults)] = by_unit(
                columns, lin["recording"] + " " + lin["groups"].map(str)
            )
        return by_faults

    # -- costs -------------------------------------------------------------------------------

    def averages(self) -> pd.DataFrame:
        costs, groups = self.take("costs").map(np.array), self.take("groups").map(np.array)
        seed = self.options.seed
        ends = {
            model: average_interval(list(costs.loc[model]), list(groups.loc[model]), seed)
            for model in MODELS
        }
        return pd.DataFrame(
            {
                "printed": printed.average_costs,
                "here": self.costs()[AVERAGE],
                **pd.DataFrame(ends, index=["95 % low", "95 % high"]).T,
                "paper's optimiser": self.costs("descend")[AVERAGE],
                "weights in box": self.costs(box=True)[AVERAGE],
                "faults dropped": self.costs(faults="drop")[AVERAGE],
            },
            index=pd.Index(MODELS, name="model"),
        )

    def recordings(self) -> pd.DataFrame:
        kept, dropped = (self.stores[p].manifest["recordings"] for p in ("keep", "drop"))
        rows = []
        for name, groups in self.take("groups").loc["lin"].items():
            sequences = self.recording(str(name))
            rows.append(
                {
                    "recording": name,
                    "sequences": kept[name]["kept"],
                    "without faults": dropped[name]["kept"],
                    "groups": max(groups) + 1,
                    "vehicles": sum(s.n_agents for s in sequences),
                    "longest (s)": max(s.time[-1] - s.time[0] for s in sequences),
                }
            )
        return pd.DataFrame(rows, index=pd.RangeIndex(1, len(rows) + 1, name="number"))

    def lengths(self) -> pd.DataFrame:
        lengths, low, high = self.parameter("L", LAWS)
        theirs = as_printed(printed.lengths, printed.average_lengths)
        table = side_by_side(averaged(lengths), theirs)
        ends = pd.concat({"95 % low": low, "95 % high": high}, names=["", "model"]).swaplevel()
        return pd.concat([table, ends]).sort_index(level=0, sort_remaining=False)

    def beside_printed(self) -> pd.DataFrame:
        return side_by_side(self.costs(), as_printed(printed.costs, printed.average_costs))

    def lower(self) -> pd.DataFrame:
        """The printed costs that are lower, with all that the searches found."""
        here = self.take("cost").astype(float).stack()
        theirs = pd.DataFrame(printed.costs, index=printed.recordings).T.stack()
        table = pd.DataFrame({"printed": theirs.reindex(here.index), "here": here})
        table = table[table["printed"] <= table["here"] - 0.005]
        searched = "before" in self.results
        table["first search"] = self.take("before").stack() if searched else np.nan
        table["best tenth of starts"] = self.take("best_tenth").stack().astype(float)
        scans = self.results.query("task == 'scan'").set_index(["model", "recording"])
        table["grid"] = scans["cost"]
        lengths = pd.DataFrame(printed.lengths, index=printed.recordings)
        table["grid, printed L"] = pd.Series(
            {
                (model, name): scan["by_length"][
                    np.abs(np.array(scan["lengths"]) - lengths.loc[name, model]).argmin()
                ]
                for (model, name), scan in scans.iterrows()
            }
        )
        return table

    def box(self) -> pd.DataFrame:
        costs = {"box": self.costs(box=True), "free": self.costs().loc[list(NETWORKS)]}
        return pd.concat(costs, names=["", "model"]).swaplevel().sort_index()

    def heldout_costs(self) -> pd.DataFrame:
        parts = {
            faults: pd.DataFrame(
                {
                    "mean": costs.mean(),
                    "median": costs.median(),
                    "90 % quantile": costs.quantile(0.9),
                    "sequences": len(costs),
                }
            )
            for faults, costs in self.heldout.items()
        }
        stacked = pd.concat(parts, names=["faults", "model"])
        order = [*BASELINES, *LAWS, *(m + s for m in NETWORKS for s in ("-box", ""))]
        return stacked.reindex([(f, m) for f in ("keep", "drop") for m in order])

    def significance(self) -> Any:
        models = [*LAWS, *(m + "-box" for m in NETWORKS), "no_interaction"]
        pairs: Any = differences(self.heldout["keep"], combinations(models, 2), self.options.seed)
        pairs["first is better (%)"] = 100 * pairs.pop("better")
        pairs.index = pd.Index([" − ".join(pair) for pair in pairs.index], name="pair")
        return pairs.assign(**{"p, Holm": pd.Series(holm(pairs["p"].to_dict()))})

    def optimizers(self) -> pd.DataFrame:
        start = self.take("history", "descend").map(lambda h: h[0][1]).mean(axis=1)
        names = {"BFGS": "fit", "ADADELTA": "descend"}
        costs = {name: self.costs(task)[AVERAGE] for name, task in names.items()}
        residuals = {
            f"residual, {name}": self.take("residual", task).astype(float).median(axis=1)
            for name, task in names.items()
        }
        return pd.DataFrame({"at the start": start, **costs, **residuals}).loc[list(MODELS)]

    def steps(self) -> pd.DataFrame:
        costs, cost = self.take("steps_costs"), self.take("cost")
        ratios = {
            f"{step} s": costs.map(itemgetter(step)) / cost
            for step in sorted(costs.iloc[0, 0], key=float, reverse=True)
        }
        return pd.DataFrame(
            {step: 100 * (r.astype(float).median(axis=1) - 1) for step, r in ratios.items()}
        )

    def parameters(self) -> pd.DataFrame:
        optimizers = {"fit": "bfgs", "descend": "adadelta"}
        fits = self.results.dropna(subset="parameters")
        fits = fits.assign(optimizer=fits["task"].map(optimizers), J=fits["cost"])
        names = ["optimizer", "faults", "recording", "model", "box"]
        table = by_number(fits[[*names, "parameters", "J"]], "parameters")
        return table[[*names, "parameter", "index", "value", "J"]]

    def draw_descents(self) -> Figure:
        """Simulations, and the average cost above the least known, of the better run."""
        history = self.take("history", "descend").map(np.array)
        lowest = np.minimum(self.costs(), self.costs("descend"))
        curves = {}
        for model, runs in history.iterrows():
            above = [run[:, 1] - lowest.loc[model, name] for name, run in runs.items()]
            simulations = np.maximum(runs.iloc[0][:, 0] * GRADIENT * 2, 1)
            curves[model] = np.stack([simulations, np.mean(above, axis=0).clip(min=1e-6)], 1)
        return plot_descents(curves)

    # -- laws --------------------------------------------------------------------------------

    def leader_speeds(self) -> pd.DataFrame:
        return averaged(self.parameter("v0")[0] * KMH)

    def draw_leader_speeds(self) -> Figure:
        return plot_leader_speeds(*(KMH * values for values in self.parameter("v0")))

    def speeds_by_gap(self, box: bool) -> dict[str, pd.DataFrame]:
        """By recording, a column of speeds (m/s) per model."""
        by_recording = self.take("speeds")
        if box:
            by_recording.update(self.take("speeds", box=True))
        return {n: pd.DataFrame(dict(by_recording[n]), index=list(GAPS)) for n in by_recording}

    def laws(self) -> pd.DataFrame:
        speeds = pd.concat(self.speeds_by_gap(False), names=["recording", "gap"])
        shown = speeds.index.get_level_values("gap") == 20.0
        return pd.concat([speeds[shown], speeds[~shown]])

    def draw_laws(self, box: bool) -> Figure:
        drawn = {} if box else self.take("bootstrap").map(lambda b: np.array(b["speeds"]))
        speeds = self.speeds_by_gap(box)
        gaps = {name: measured_gaps(self.recording(name)) for name in speeds}
        return plot_law_panels(speeds, drawn, gaps)

    # -- sequences ---------------------------------------------------------------------------

    @cached_property
    def by_sequence(self) -> pd.DataFrame:
        """A row per sequence, and by model its share of the recording's cost (%)."""
        costs = self.take("costs")
        faults: Any = pd.DataFrame(
            self.stores["keep"].manifest["faults"], columns=["sequence", "kind"]
        )
        kinds = faults.groupby("sequence")["kind"].agg(lambda kind: ", ".join(sorted(set(kind))))
        rows = [
            {
                "number": number,
                "sequence": s.name,
                "vehicles": s.n_agents,
                "start (s)": float(s.time[0]),
                "faults": kinds.get(s.name, "none found"),
            }
            for number, name in enumerate(costs.columns, 1)
            for s in self.recording(name)
        ]
        shares = costs.map(lambda each: 100 * np.array(each) / np.sum(each))
        return pd.DataFrame(rows).assign(
            **{f"share {model} (%)": np.concatenate(list(shares.loc[model])) for model in MODELS}
        )

    def faulty(self) -> pd.DataFrame:
        """What faulty sequences are of all, of the cost, and how much lower it is without them."""
        every = self.by_sequence
        faulty = every["faults"] != "none found"
        shares = every.filter(like="share ").mul(faulty, axis=0).groupby(every["number"]).sum()
        ratio = self.costs()[AVERAGE] / self.costs(faults="drop")[AVERAGE]
        return pd.DataFrame(
            {
                "faulty sequences": faulty.sum(),
                "all sequences": len(every),
                "their share of the cost (%)": shares.mean().to_numpy(),
                "cost over that without them": ratio[list(MODELS)],
            },
            index=pd.Index(MODELS, name="model"),
        )

    def dominating_sequences(self) -> Any:
        shares = [f"share {model} (%)" for model in SPLIT]
        columns = ["sequence", "vehicles", "start (s)", *shares, "faults"]
        table = self.by_sequence.sort_values(shares[0], ascending=False)
        table = table.groupby("number").head(NAMED).sort_values("number", kind="stable")
        return table.set_index("number")[columns]

    @property
    def dominating(self) -> str:
        """The sequence of the greatest share of its recording's cost under the linear law."""
        return str(self.by_sequence.set_index("sequence")["share lin (%)"].idxmax())

    def draw_dominating(self) -> Figure:
        name = self.dominating.rsplit("/", 1)[0]
        (sequence,) = (s for s in self.recording(name) if s.name == self.dominating)
        parameters = self.take("parameters")[name]
        systems = {model: system_of(model, parameters[model]) for model in SPLIT}
        (scene,) = scenes([sequence], systems, self.options.dt)
        marked = [
            (int(agent), float(fault["time"]))
            for fault in self.stores["keep"].manifest["faults"]
            if fault["sequence"] == sequence.name and fault["time"] is not None
            for agent in fault["agents"]
        ]
        return plot_space_time(scene, marked)

    def scenes(self) -> list[Scene]:
        """Sequences without a fault, of the player."""
        shown = []
        for name, parameters in self.take("parameters", faults="drop").items():
            systems = {m: system_of(m, parameters[m]) for m in SHOWN}
            sequences = thinned(self.recording(str(name), "drop"), FEW)
            shown += scenes(sequences, systems, self.options.dt)
        return shown


#: Speeds outside are cut, m/s.
LIMITS = (-8.0, 38.0)


def plot_leader_speeds(speeds: pd.DataFrame, low: pd.DataFrame, high: pd.DataFrame) -> Figure:
    """Identified speed of the leading vehicle by recording, and its mean by model.

    Args:
        speeds: km/h; a row per model, a column per recording.
        low, high: ends of their intervals, the same layout, NaN where there is none.

    Source: Göttlich & Totzeck, figure (veloLength).
    """
    figure = new_figure(7.2, 4.0)
    ax = figure.subplots()
    error_bars(ax, speeds, low, high, 0.14, linestyle="")
    handles = []
    for i, (model, mean) in enumerate(speeds.mean(axis=1).items()):
        style = curve_style(i)
        ax.axhline(mean, color=style["color"], linestyle=style["linestyle"], linewidth=1)
        label = f"{model}: mean {mean:.0f} km/h"
        handles.append(Line2D([], [], **style, markersize=4.5, label=label))
    numbered = [f"{n}\n{name}" for n, name in enumerate(speeds.columns, 1)]
    ax.set_xticks(range(len(numbered)), numbered)
    dress(ax, x="recording", y="leader's speed v0 (km/h)")
    legend_above(figure, handles)
    return figure


def plot_law_panels(
    speeds: Mapping[str, pd.DataFrame],
    bands: Mapping[str, Mapping[str, np.ndarray]],
    measured: Mapping[str, np.ndarray],
) -> Figure:
    """Speed against gap, one panel per recording, all models.

    Args:
        speeds: recording to m/s, a column per model, indexed by the gap, m.
        bands: recording to model to ``(2, G)`` ends of the interval, m/s; may be empty.
        measured: recording to measured gaps, m; a bar below shows their middle 90 %.

    Source: Göttlich & Totzeck, figure (interactionForce).
    """
    rows = -(-len(speeds) // 5)
    figure = new_figure(11.0, 2.5 * rows + 0.4)
    axes = figure.subplots(rows, 5, sharex=True, sharey=True, squeeze=False)
    handles: list[Line2D] = []
    for n, (name, table) in enumerate(speeds.items()):
        ax, handles = axes.flat[n], []
        for i, (model, speed) in enumerate(table.items()):
            style = {**curve_style(i), "marker": ""}
            ax.plot(table.index, speed.clip(-1e3, 1e3), linewidth=1.2, **style)
            handles.append(Line2D([], [], **style, label=model))
            if name in bands:
                low, high = np.clip(bands[name][str(model)], -1e3, 1e3)
                ax.fill_between(
                    table.index, low, high, color=style["color"], alpha=0.10, linewidth=0
                )
        span = np.quantile(measured[name], [0.05, 0.95])
        ax.plot(span, [LIMITS[0] + 1.5] * 2, color=GREY, linewidth=4, solid_capstyle="butt")
        last = n // 5 == rows - 1
        dress(
            ax,
            x="gap (m)" if last else "",
            y="speed W (m/s)" if n % 5 == 0 else "",
            title=f"{n + 1}: {name}",
        )
    for ax in axes.flat[len(speeds) :]:
        ax.set_axis_off()
    axes[0, 0].set(xlim=(table.index.min(), table.index.max()), ylim=LIMITS)
    handles.append(Line2D([], [], color=GREY, linewidth=4, label="middle 90 % of measured gaps"))
    legend_above(figure, handles, len(handles))
    return figure


def plot_descents(curves: Mapping[str, np.ndarray]) -> Figure:
    """Average cost above the least one known, against simulations, one curve per model.

    Args:
        curves: model to ``(P, 2)`` simulations and excess of the average cost, m² s.
    """
    figure = new_figure(5.6, 3.2)
    ax = figure.subplots()
    for i, (model, values) in enumerate(curves.items()):
        ax.plot(*values.T, **{**curve_style(i), "marker": ""}, linewidth=1.3, label=model)
    ax.set(xscale="log", yscale="log")
    ax.set_ylim(bottom=max(ax.get_ylim()[0], 1e-3))  # lower values are rounding errors
    dress(ax, x="simulations", y="average J above the least (m² s)")
    ax.legend(fontsize=SMALL_FONT, frameon=False)
    return figure


def plot_space_time(scene: Scene, marked: list[tuple[int, float]]) -> Figure:
    """One traffic sequence: measured positions and simulated ones.

    Args:
        marked: vehicles and times (s) at which a fault of the measurement was found.
    """
    figure = new_figure(6.4, 3.8)
    ax = figure.subplots()
    sequence = scene.sequence
    t = sequence.time - sequence.time[0]
    handles = [Line2D([], [], color=GREY, marker="o", markersize=4, label="measured")]
    ax.plot(t, sequence.x[:, :, 0], color=GREY, marker="o", markersize=4, linewidth=1)
    for i, (name, x) in enumerate(scene.simulated.items()):
        style = {**curve_style(i), "marker": ""}
        ax.plot(t, x[:, :, 0], **style, linewidth=1.3)
        handles.append(Line2D([], [], **style, label=name))
    for agent, time in marked:
        k = int(np.abs(sequence.time - time).argmin())
        ax.plot(t[k], sequence.x[k, agent, 0], "s", color="black", fillstyle="none", markersize=10)
    if marked:
        box: dict[str, Any] = {"marker": "s", "fillstyle": "none", "markersize": 8, "linestyle": ""}
        handles.append(Line2D([], [], color="black", **box, label="fault of the measurement"))
    dress(ax, x="time in the sequence (s)", y="position along the lane (m)", title=sequence.name)
    ax.legend(handles=handles, fontsize=SMALL_FONT)
    return figure
