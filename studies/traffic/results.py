"""Tables and figures of the traffic study."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import combinations
from operator import itemgetter
from typing import Any

import numpy as np
import pandas as pd
import torch
from matplotlib.figure import Figure

from nnode.calibrate.resampling import average_interval, holm
from nnode.data.sequence import collate
from nnode.data.store import Store
from nnode.pages.replay import ReplayBlock
from nnode.plots.style import thinned
from nnode.plots.traffic import measured_gaps
from nnode.simulation.fused import FusedSolver
from studies.frame import by_number, by_unit, differences
from studies.options import TrafficStudyOptions
from studies.replay import player, scenes
from studies.traffic import figures, printed, tasks
from studies.traffic.problem import GAPS, recording, system_of

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


def side_by_side(ours: Any, theirs: Any) -> Any:
    """Our rows, the printed ones and the differences, one under the other by model."""
    theirs = theirs.loc[ours.index, ours.columns]
    parts = {"here": ours, "printed": theirs, "difference": ours - theirs}
    stacked = pd.concat(parts, names=["", "model"]).swaplevel()
    return stacked.reindex([(model, part) for model in ours.index for part in parts])


def as_printed(table: dict[str, Any], averages: dict[str, float]) -> Any:
    """A table of the paper: a row per model, a column per recording, the averages as printed."""
    rows = pd.DataFrame(table, index=list(printed.recordings)).T
    return rows.assign(**{AVERAGE: pd.Series(averages)})


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

    def parameter(self, name: str, models: tuple[str, ...]) -> Any:
        """A scalar parameter of the best fits, and both ends of its bootstrap interval."""
        values = self.take("parameters").loc[list(models)].map(lambda p: p[name])
        drawn = self.take("bootstrap").loc[list(models)].map(lambda b: b["values"][name])
        return values, *(drawn.map(lambda v, q=q: np.quantile(v, q)) for q in (0.025, 0.975))

    @cached_property
    def heldout(self) -> dict[str, pd.DataFrame]:
        """By treatment of faults, a column of held-out costs (m² s) per model and baseline."""
        every = self.results.query("task == 'cross_validate'").dropna(subset="groups")
        every = every.explode(["costs", "groups", *tasks.BASELINES])
        by_faults = {}
        for faults, part in every.groupby("faults"):
            columns = {str(law): rows["costs"] for law, rows in part.groupby("law", sort=False)}
            lin = part[part["law"] == "lin"]
            columns |= {name: lin[name] for name in tasks.BASELINES}
            by_faults[str(faults)] = by_unit(
                columns, lin["recording"] + " " + lin["groups"].map(str)
            )
        return by_faults

    # -- tables ------------------------------------------------------------------------------

    def tables(self) -> dict[str, pd.DataFrame]:
        """By their names in the template."""
        ours, theirs = self.costs(), as_printed(printed.costs, printed.average_costs)
        box, dropped = self.costs(box=True), self.costs(faults="drop")
        speeds = self.parameter("v0", MODELS)[0] * KMH
        lengths, low, high = self.parameter("L", LAWS)
        printed_lengths = as_printed(printed.lengths, printed.average_lengths)
        table_1 = side_by_side(averaged(lengths), printed_lengths)
        ends = pd.concat({"95 % low": low, "95 % high": high}, names=["", "model"]).swaplevel()
        both = pd.concat({"box": box, "free": ours.loc[list(NETWORKS)]}, names=["", "model"])
        return {
            "averages": self._averages(),
            "recordings": self._recordings(),
            "table_1": pd.concat([table_1, ends]).sort_index(level=0, sort_remaining=False),
            "table_2": ours,
            "table_2_printed": side_by_side(ours, theirs),
            "table_2_lower": self._lower(ours, theirs, printed_lengths),
            "table_2_box": both.swaplevel().sort_index(),
            "leader_speeds": averaged(speeds),
            "laws": self._laws(),
            "heldout": self._heldout(),
            "significance": self._significance(),
            "optimizers": self._optimizers(),
            "steps": self._steps(),
            "faulty": self._faulty(ours, dropped),
            "dominating_sequences": self._dominating(),
            "table_2_dropped": dropped,
            "parameters": self._parameters(),
        }

    def _averages(self) -> pd.DataFrame:
        costs, groups = self.take("costs"), self.take("groups")
        rows = {}
        for model in MODELS:
            each, clusters = ([np.array(v) for v in table.loc[model]] for table in (costs, groups))
            rows[model] = average_interval(each, clusters, self.options.seed)
        ends = pd.DataFrame(rows, index=["95 % low", "95 % high"]).T
        return pd.DataFrame(
            {
                "printed": printed.average_costs,
                "here": self.costs()[AVERAGE],
                **ends,
                "paper's optimiser": self.costs("descend")[AVERAGE],
                "weights in box": self.costs(box=True)[AVERAGE],
                "faults dropped": self.costs(faults="drop")[AVERAGE],
            },
            index=pd.Index(MODELS, name="model"),
        )

    def _recordings(self) -> pd.DataFrame:
        kept, dropped = (self.stores[p].manifest["recordings"] for p in ("keep", "drop"))
        groups = self.take("groups").loc["lin"]
        rows = {}
        for number, name in enumerate(groups.index, 1):
            sequences = recording(str(self.stores["keep"].folder), name)
            rows[number] = {
                "recording": name,
                "sequences": kept[name]["kept"],
                "without faults": dropped[name]["kept"],
                "groups": int(max(groups[name])) + 1,
                "vehicles": sum(s.n_agents for s in sequences),
                "longest (s)": max(s.time[-1] - s.time[0] for s in sequences),
            }
        return pd.DataFrame.from_dict(rows, orient="index").rename_axis("number")

    def _lower(self, ours: Any, theirs: Any, lengths: Any) -> pd.DataFrame:
        """The printed costs that are lower, with all that the searches found."""
        here = ours.drop(columns=AVERAGE).stack()
        table = pd.DataFrame({"printed": theirs.stack().reindex(here.index), "here": here})
        table = table[table["printed"] <= table["here"] - 0.005]
        again = "before" in self.results
        table["first search"] = self.take("before").stack() if again else np.nan
        table["best tenth of starts"] = self.take("starts").stack().map(itemgetter(1))
        scans = self.results.query("task == 'scan'").set_index(["model", "recording"])
        table["grid"] = scans["cost"]
        table["grid, printed L"] = pd.Series(
            {
                (model, name): scan["by_length"][
                    int(np.abs(np.array(scan["lengths"]) - lengths.loc[model, name]).argmin())
                ]
                for (model, name), scan in scans.iterrows()
            }
        )
        return table

    def _speeds_by_gap(self, box: bool) -> dict[str, pd.DataFrame]:
        """By recording, a column of speeds (m/s) per model."""
        by_recording = self.take("speeds")
        if box:
            by_recording.update(self.take("speeds", box=True))
        return {
            str(n): pd.DataFrame(dict(by_recording[n]), index=list(GAPS))
            for n in by_recording.columns
        }

    def _laws(self) -> pd.DataFrame:
        speeds = pd.concat(self._speeds_by_gap(False), names=["recording", "gap"])
        shown = speeds.index.get_level_values("gap") == 20.0
        return pd.concat([speeds[shown], speeds[~shown]])

    def _heldout(self) -> pd.DataFrame:
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
        order = [*tasks.BASELINES, *LAWS, *(m + s for m in NETWORKS for s in ("-box", ""))]
        return stacked.reindex([(f, m) for f in ("keep", "drop") for m in order])

    def _significance(self) -> pd.DataFrame:
        models = [*LAWS, *(m + "-box" for m in NETWORKS), "no_interaction"]
        pairs = differences(self.heldout["keep"], combinations(models, 2), self.options.seed)
        pairs = pairs.assign(**{"first is better (%)": 100 * pairs.pop("better")})
        pairs.index = pd.Index([" − ".join(pair) for pair in pairs.index], name="pair")
        corrected = holm(dict(zip(map(str, pairs.index), pairs["p"], strict=True)))
        return pairs.assign(**{"p, Holm": list(corrected.values())})

    def _optimizers(self) -> pd.DataFrame:
        start = self.take("history", "descend").map(lambda h: h[0][1]).mean(axis=1)
        costs = {k: self.costs(t)[AVERAGE] for k, t in (("BFGS", "fit"), ("ADADELTA", "descend"))}
        left = {
            f"residual, {k}": self.take("residual", t).astype(float).median(axis=1)
            for k, t in (("BFGS", "fit"), ("ADADELTA", "descend"))
        }
        return pd.DataFrame({"at the start": start, **costs, **left}).loc[list(MODELS)]

    def _steps(self) -> pd.DataFrame:
        steps, costs = self.take("steps_costs"), self.take("cost")
        changes = {}
        for step in sorted(map(float, steps.iloc[0, 0]), reverse=True):
            ratio = steps.map(lambda s, h=step: s[f"{h:g}"]) / costs
            changes[f"{step:g} s"] = 100 * (ratio.astype(float).median(axis=1) - 1)
        return pd.DataFrame(changes)

    @cached_property
    def by_sequence(self) -> pd.DataFrame:
        """A row per sequence, and by model its share of the recording's cost (%)."""
        store, costs = self.stores["keep"], self.take("costs")
        kinds: dict[str, set[str]] = {}
        for fault in store.manifest["faults"]:
            kinds.setdefault(fault["sequence"], set()).add(fault["kind"])
        rows = [
            {
                "number": number,
                "sequence": s.name,
                "vehicles": s.n_agents,
                "start (s)": float(s.time[0]),
                "faults": ", ".join(sorted(kinds.get(s.name, ()))) or "none found",
            }
            for number, name in enumerate(costs.columns, 1)
            for s in recording(str(store.folder), name)
        ]
        shares = costs.map(lambda each: 100 * np.array(each) / np.sum(each))
        return pd.DataFrame(rows).assign(
            **{f"share {model} (%)": np.concatenate(list(shares.loc[model])) for model in MODELS}
        )

    def _faulty(self, ours: Any, dropped: Any) -> pd.DataFrame:
        """What faulty sequences are of all, of the cost, and how much lower it is without them."""
        every = self.by_sequence
        faulty = every["faults"] != "none found"
        shares = every.filter(like="share ").mul(faulty, axis=0).groupby(every["number"]).sum()
        return pd.DataFrame(
            {
                "faulty sequences": int(faulty.sum()),
                "all sequences": len(every),
                "their share of the cost (%)": shares.mean().to_numpy(),
                "cost over that without them": (ours[AVERAGE] / dropped[AVERAGE])[list(MODELS)],
            },
            index=pd.Index(MODELS, name="model"),
        )

    def _dominating(self) -> Any:
        shares = [f"share {model} (%)" for model in SPLIT]
        columns = ["sequence", "vehicles", "start (s)", *shares, "faults"]
        table = self.by_sequence.sort_values(shares[0], ascending=False)
        table = table.groupby("number").head(NAMED).sort_values("number", kind="stable")
        return table.set_index("number")[columns]

    def _parameters(self) -> pd.DataFrame:
        optimizers = {"fit": "bfgs", "descend": "adadelta"}
        fits = self.results.dropna(subset="parameters")
        fits = fits.assign(optimizer=fits["task"].map(optimizers), J=fits["cost"])
        names = ["optimizer", "faults", "recording", "model", "box"]
        table = by_number(fits[[*names, "parameters", "J"]], "parameters")
        return table[[*names, "parameter", "index", "value", "J"]]

    # -- figures -----------------------------------------------------------------------------

    def figures(self) -> dict[str, Figure | ReplayBlock]:
        """By their names in the template."""
        folder = str(self.stores["keep"].folder)
        gaps = {str(n): measured_gaps(recording(folder, n)) for n in self.take("cost").columns}
        drawn = self.take("bootstrap")
        bands = {str(n): {m: np.array(drawn.loc[m, n]["speeds"]) for m in MODELS} for n in drawn}
        return {
            "leader_speeds": figures.leader_speeds(
                *(KMH * p for p in self.parameter("v0", MODELS))
            ),
            "laws_box": figures.law_panels(GAPS, self._speeds_by_gap(True), {}, gaps),
            "laws": figures.law_panels(GAPS, self._speeds_by_gap(False), bands, gaps),
            "descents": figures.descents(self._descents()),
            "dominating_sequence": self._drawn(),
            "replay": self._replay(),
        }

    def _descents(self) -> dict[str, np.ndarray]:
        """Simulations, and the average cost above the least known, of the better run."""
        history, costs = self.take("history", "descend"), self.costs()
        least = np.minimum(costs, self.costs("descend")).drop(columns=AVERAGE)
        curves = {}
        for model in MODELS:
            each = [
                np.array(h)[:, 1] - c
                for h, c in zip(history.loc[model], least.loc[model], strict=True)
            ]
            count = np.array(history.loc[model].iloc[0])[:, 0] * GRADIENT * 2
            above = np.mean(each, axis=0).clip(min=1e-6)
            curves[model] = np.stack([np.maximum(count, 1), above], 1)
        return curves

    @property
    def dominating(self) -> str:
        """The sequence of the greatest share of its recording's cost under the linear law."""
        return str(self.by_sequence.set_index("sequence")["share lin (%)"].idxmax())

    def _drawn(self) -> Figure:
        name = self.dominating.rsplit("/", 1)[0]
        every = recording(str(self.stores["keep"].folder), name)
        (sequence,) = (s for s in every if s.name == self.dominating)
        simulated = {}
        for model in SPLIT:
            system = system_of(model, self.take("parameters").loc[model, name])
            with torch.no_grad():
                run = FusedSolver(self.options.dt)(system, collate([sequence]))
            simulated[model] = run.x[:, 0, :, 0].numpy()
        marked = [
            (int(agent), float(fault["time"]))
            for fault in self.stores["keep"].manifest["faults"]
            if fault["sequence"] == sequence.name and fault["time"] is not None
            for agent in fault["agents"]
        ]
        return figures.space_time(sequence, simulated, marked)

    def _replay(self) -> ReplayBlock:
        parameters = self.take("parameters", faults="drop")
        every, number = [], 0
        for name in parameters.columns:
            sequences = recording(str(self.stores["drop"].folder), name)
            systems = {m: system_of(m, parameters.loc[m, name]) for m in SHOWN}
            every += scenes(thinned(sequences, FEW), systems, self.options.dt)
            number += len(sequences)
        what = (
            "Sequences without a fault of every recording, as measured and as simulated by "
            f"{' and '.join(SHOWN)}, which are calibrated to the recording."
        )
        return player(every, what, number)

    def values(self) -> dict[str, Any]:
        """What else the template refers to."""
        return {"options": self.options, "dominating": self.dominating, "gradient": GRADIENT}
