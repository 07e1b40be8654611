"""Tables and figures of the study."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from nnode.data.sequence import Sequence, collate
from nnode.data.store import Store
from nnode.model.system import System
from nnode.pages.replay import Scene
from nnode.plots.crowd import force_contours
from nnode.plots.settings import SETTINGS, Setting, six_settings
from nnode.plots.style import (
    GREY,
    OKABE_ITO,
    SHADE,
    SMALL_FONT,
    curve_style,
    dress,
    legend_above,
    new_figure,
    thinned,
)
from studies.crowd import forces, printed
from studies.crowd.data import ALL, RECORDING, mean_speed, time_groups
from studies.crowd.tasks import KINDS, NAMES, named, system_of
from studies.figures import horizon_costs
from studies.frame import by_number, by_unit, differences, labelled, means
from studies.options import CrowdStudyOptions
from studies.replay import scenes
from studies.stores import sequences

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
MODELS = tuple(KINDS)
#: What is compared on held-out sequences.
COMPARED = (("sf", "relaxation"), ("nn", "sf"), ("nn", "wall"), ("wall", "sf"))
#: Parts of the force that are drawn.
PARTS = {"sf": ("pair", "wall"), "nn": ("sum", "pair", "wall")}
#: Models in the player, and how many sequences.
SHOWN, FEW = ("sf", "nn"), 8


def by_person(table: pd.DataFrame) -> pd.DataFrame:
    """A table of :func:`nnode.plots.settings.six_settings` with a row per setting and person.

    Returns:
        Indexed by setting and person: ``x`` (m), ``v`` (m/s) and ``force`` (N); a cell is (x, y).
    """
    people = {
        person: table.set_index("setting")[[f"{what}_{person}" for what in ("x", "v", "force")]]
        for person in ("blue", "red")
    }
    parts = {person: part.set_axis(["x", "v", "force"], axis=1) for person, part in people.items()}
    return pd.concat(parts, names=["person"]).swaplevel().sort_index()


def beside_printed(model: str, table: pd.DataFrame) -> pd.DataFrame:
    """The places and velocities, our forces and the printed ones; a row per setting and person.

    Args:
        model: ``sf`` or ``nn``.
        table: of :func:`nnode.plots.settings.six_settings`.
    """
    people = by_person(table)
    told = np.reshape(printed.forces[model], (-1, 2))
    columns: dict[str, Any] = {
        "place (m)": [f"({x:g}; {y:g})" for x, y in people["x"]],
        "velocity (m/s)": [f"({x:g}; {y:g})" for x, y in people["v"]],
    }
    for i, letter in enumerate("xy"):
        columns[f"F_{letter}"] = people["force"].str[i]
        columns[f"F_{letter} printed"] = told[:, i]
    return pd.DataFrame(columns, index=people.index)


@dataclass
class Crowd:
    """Options, prepared data by ``main`` or ``others`` and horizon (s), and a row per task."""

    options: CrowdStudyOptions
    stores: dict[tuple[str, float], Store]
    results: Any = field(default_factory=pd.DataFrame)

    def add(self, horizon: float, results: pd.DataFrame) -> None:
        """The results of tasks at a horizon."""
        results = results.assign(horizon=horizon)
        self.results = pd.concat([self.results, results], ignore_index=True)

    @property
    def scopes(self) -> list[str]:
        """All sequences, and all but each block of time."""
        return [ALL, *(f"fold-{n}" for n in range(self.options.folds))]

    @cached_property
    def span(self) -> tuple[float, float]:
        """First and last time of the paper's recording, s."""
        index = self.stores["main", self.options.horizons[0]].index
        return min(e["start"] for e in index), max(e["end"] for e in index)

    @property
    def step(self) -> float:
        """Sampling interval of the paper's recording, s."""
        return float(self.stores["main", self.options.horizons[0]].manifest["dt"])

    def folder(self, part: str, horizon: float) -> str:
        """Of the prepared sequences."""
        return str(self.stores[part, horizon].folder)

    def take(self, task: str, horizon: float) -> Any:
        """The rows of one function at a horizon."""
        return self.results.query("task == @task and horizon == @horizon")

    @property
    def every_fit(self) -> Any:
        """All calibrations. Beside rows of other tasks, pandas keeps whole numbers as floats."""
        fits = self.results.query("task == 'fit'")
        return fits.astype({"seed": int, "evaluations": int})

    def fits(self, kind: str, scope: str, horizon: float) -> Any:
        """Calibrations from all starts, lowest training cost first."""
        chosen = "kind == @kind and scope == @scope and horizon == @horizon"
        return self.every_fit.query(chosen).sort_values("J")

    def best(self, kind: str, scope: str, horizon: float) -> Any:
        """The calibration of lowest training cost."""
        return self.fits(kind, scope, horizon).iloc[0]

    def system(self, model: str, horizon: float) -> System:
        """A model as calibrated to all sequences."""
        start = self.best(model, ALL, horizon)
        return system_of(KINDS[start["kind"]], start["row"])

    def costs(self, horizon: float, *, heldout: bool) -> pd.DataFrame:
        """Costs by sequence (m² s), a column per model and baseline.

        Args:
            heldout: of models that were calibrated without a sequence's block of time, in place of
                all sequences training.
        """
        part, scopes = ("heldout", self.scopes[1:]) if heldout else ("train", [ALL])
        costs = {
            model: pd.concat(pd.Series(self.best(model, s, horizon)[part]) for s in scopes)
            for model in MODELS
        }
        names = costs["sf"].index
        costs |= self.take("baselines", horizon)["costs"].iloc[0]
        table = pd.DataFrame({label: pd.Series(costs[name]) for name, label in LABELS.items()})
        every = sequences(self.folder("main", horizon))
        group = dict(zip((s.name for s in every), time_groups(every), strict=True))
        return by_unit(table.loc[names], [group[name] for name in names], names)

    # -- tables ------------------------------------------------------------------------------

    def data(self) -> pd.DataFrame:
        rows = {}
        for (part, horizon), store in self.stores.items():
            people = [entry["n_agents"] for entry in store.index]
            rows[RECORDING if part == "main" else "other two-way runs", f"{horizon:g} s"] = {
                "sequences": len(people),
                "left out as faulty": store.manifest["counts"]["dropped"],
                "people, mean": np.mean(people),
                "people, most": max(people),
            }
        return labelled(rows, "recording", "length")

    def parameters(self) -> pd.DataFrame:
        """A, k, kappa by horizon with 95 % intervals, printed ones first."""
        rows: dict[str, Any] = {"printed, 1 s": printed.parameters}
        for horizon in self.options.horizons:
            drawn = self.take("resample", horizon).sort_values("first")["rows"]
            low, high = np.quantile(np.concatenate(list(drawn)), [0.025, 0.975], axis=0)
            ends = {"": self.best("sf", ALL, horizon)["row"], " from": low, " to": high}
            rows[f"here, {horizon:g} s"] = {
                f"{name}{end}": values[i]
                for i, name in enumerate(NAMES)
                for end, values in ends.items()
            }
        columns = list(rows[f"here, {horizon:g} s"])
        return pd.DataFrame.from_dict(rows, orient="index").reindex(columns=columns)

    def first_costs(self) -> pd.DataFrame:
        """Costs of the first horizon, all sequences training."""
        costs = means(self.costs(self.options.horizons[0], heldout=False), self.options.seed)
        told = pd.Series({LABELS[m]: cost for m, cost in printed.costs.items()})
        return pd.DataFrame(
            {
                "printed (m²)": told.reindex(costs.index),
                "here (m²)": costs["mean"] / self.step,
                "here (m² s)": costs["mean"],
                "from": costs["low"],
                "to": costs["high"],
            }
        )

    def horizons(self) -> pd.DataFrame:
        parts = {
            name: pd.DataFrame(
                {f"{h:g} s": self.costs(h, heldout=out).mean() for h in self.options.horizons}
            )
            for name, out in (("training", False), ("held out", True))
        }
        return pd.concat(parts, names=["", "model"])

    def paired_differences(self) -> pd.DataFrame:
        pairs = [(LABELS[a], LABELS[b]) for a, b in COMPARED]
        parts = {
            f"{h:g} s": differences(self.costs(h, heldout=True), pairs, self.options.seed)
            for h in self.options.horizons
        }
        return pd.concat(parts, names=["horizon", "model", "minus"])

    def blocks(self) -> pd.DataFrame:
        """Held-out cost of each block of time, m² s."""
        rows = {}
        shown = [LABELS[m] for m in (*MODELS, "relaxation")]
        for horizon in self.options.horizons:
            costs = self.costs(horizon, heldout=True).droplevel("cluster")[shown]
            every = {s.name: s for s in sequences(self.folder("main", horizon))}
            for number, scope in enumerate(self.scopes[1:], 1):
                names = list(self.best("sf", scope, horizon)["heldout"])
                row = _described([every[name] for name in names])
                rows[f"{horizon:g} s", f"{number}"] = row | dict(costs.loc[names].mean())
        return labelled(rows, "horizon", "block")

    def other_runs(self) -> pd.DataFrame:
        """Mean cost of a sequence in other runs, m² s."""
        rows = {}
        for horizon in self.options.horizons:
            every = sequences(self.folder("others", horizon))
            for run, costs in self.take("transfer", horizon)["runs"].iloc[0].items():
                mean = pd.DataFrame(costs)[list(LABELS)[:-1]].mean().rename(LABELS)
                row = _described([s for s in every if s.recording == run])
                rows[f"{horizon:g} s", run] = row | dict(mean)
        return labelled(rows, "horizon", "run")

    def every_parameter(self) -> pd.DataFrame:
        """All calibrations, one row per number: what is needed to compute their costs again."""
        fits = self.every_fit
        values = [named(KINDS[k], row) for k, row in zip(fits["kind"], fits["row"], strict=True)]
        names = {
            "kind": "model",
            "scope": "trained on",
            "horizon": "horizon (s)",
            "seed": "start",
        }
        table = fits[list(names)].rename(columns=names).assign(values=values)
        return by_number(table, "values").set_index(list(names.values()))

    # -- forces at the first horizon, all sequences training -----------------------------------

    @cached_property
    def measured(self) -> forces.Measured:
        """States and pairs of the people at the first horizon."""
        folder = self.folder("main", self.options.horizons[0])
        return forces.Measured.of(collate(sequences(folder)))

    @cached_property
    def starts(self) -> Any:
        """Calibrations of every kind, least cost first, with the model as ``system`` and the
        accelerations of people as ``parts``."""
        fits = pd.concat(self.fits(kind, ALL, self.options.horizons[0]) for kind in MODELS)
        models = fits["kind"].map(KINDS)
        systems = [system_of(m, row) for m, row in zip(models, fits["row"], strict=True)]
        parts = [forces.accelerations(system, self.measured) for system in systems]
        return fits.assign(system=systems, parts=parts)

    @property
    def best_parts(self) -> Any:
        """Accelerations of people by the best start of every kind."""
        return self.starts.groupby("kind", sort=False)["parts"].first()

    def restarts(self) -> pd.DataFrame:
        rows = {}
        for start in self.starts.to_dict("records"):
            kind, parts = start["kind"], start["parts"]
            row = {"J (m² s)": start["J"], "evaluations": start["evaluations"]}
            row |= dict(zip(NAMES, start["row"], strict=True)) if kind == "sf" else {}
            for part in ("pair", "wall", "sum"):
                row[f"size, {part}"] = forces.size(parts[part])
                best = self.best_parts[kind][part]
                row[f"likeness, {part}"] = forces.likeness(parts[part], best)
            rows[LABELS[kind], start["seed"]] = row
        return labelled(rows, "model", "start")

    def pull(self) -> pd.DataFrame:
        rows = {LABELS[kind]: forces.slope(parts) for kind, parts in self.best_parts.items()}
        return pd.DataFrame(rows, index=["rate (1/s)", "to the speed (m/s)"]).T

    def draw_forces(self) -> Figure:
        systems = self.starts.groupby("kind")["system"].agg(list)
        curves = {
            LABELS[kind]: [forces.away_by_distance(system, self.measured) for system in every]
            for kind, every in (("sf", systems["sf"][:1]), ("nn", systems["nn"]))
        }
        return plot_forces_by_distance(curves)

    def draw_accelerations(self) -> Figure:
        speeds = {LABELS[k]: forces.along_by_speed(parts) for k, parts in self.best_parts.items()}
        return plot_acceleration_by_speed(speeds)

    def draw_contours(self, model: str, part: Any, component: int) -> Figure:
        system = self.system(model, self.options.horizons[0])
        return force_contours(system, component, part=part)

    def settings(self, model: str) -> tuple[Figure, pd.DataFrame]:
        """The paper's six settings, drawn, and beside the printed forces."""
        figure, table = six_settings(self.system(model, self.options.horizons[0]))
        return figure, beside_printed(model, table)

    def settings_along(self) -> tuple[Figure, pd.DataFrame]:
        """The six settings with x and y exchanged: people walk as those of the recording do."""
        settings = [
            Setting(s.name, s.x_blue[::-1], s.x_red[::-1], s.v_blue[::-1], s.v_red[::-1])
            for s in SETTINGS["long"]
        ]
        system = self.system("nn", self.options.horizons[0])
        figure, total = six_settings(system, settings)
        parts = {p: six_settings(system, settings, part=p)[1] for p in ("pair", "wall")}
        tables = {p: by_person(table)["force"] for p, table in {**parts, "sum": total}.items()}
        columns = {
            f"F_{letter}, {part}": force.str[i]
            for i, letter in enumerate("xy")
            for part, force in tables.items()
        }
        return figure, pd.DataFrame(columns)

    def printed_away(self) -> float:
        """Largest difference of the printed forces from those of the printed parameters, N."""
        system = system_of("sf", list(printed.parameters.values()))
        table = beside_printed("sf", six_settings(system)[1])
        return max((table[f] - table[f"{f} printed"]).abs().max() for f in ("F_x", "F_y"))

    # -- horizons ----------------------------------------------------------------------------

    def draw_horizons(self) -> Figure:
        shown = [LABELS[m] for m in ("relaxation", *MODELS, "constant_velocity", "even_pace")]
        tables = {
            h: means(self.costs(h, heldout=True), self.options.seed).loc[shown]
            for h in self.options.horizons
        }
        columns: Any = pd.concat(tables, axis=1).swaplevel(axis=1)
        return horizon_costs(columns["mean"], columns["low"], columns["high"])

    def scenes(self) -> list[Scene]:
        """Sequences of the player, of the longest horizon."""
        horizon = self.options.horizons[-1]
        systems = {LABELS[m]: self.system(m, horizon) for m in SHOWN}
        return scenes(thinned(sequences(self.folder("main", horizon)), FEW), systems)


def _described(items: list[Sequence]) -> dict[str, Any]:
    """The number of sequences, and the mean number and speed (m/s) of their people."""
    people = np.mean([s.n_agents for s in items])
    return {"sequences": len(items), "people": people, "speed": mean_speed(items)}


def plot_forces_by_distance(curves: Mapping[str, list[pd.DataFrame]]) -> Figure:
    """Mean force between two people along the line that joins them, by their distance.

    Args:
        curves: model to one table per start, the best first, with the columns ``facing`` and
            ``same way`` (N), indexed by distance (m).
    """
    figure = new_figure(7.2, 3.4)
    axes = figure.subplots(1, 2, sharey=True)
    titles = {"facing": "walking in opposite directions", "same way": "walking the same way"}
    handles = []
    for i, (model, tables) in enumerate(curves.items()):
        style = {**curve_style(i), "marker": ""}
        handles.append(Line2D([], [], **style, linewidth=1.8, label=f"{model}, best start"))
        if len(tables) > 1:
            label = f"{model}, other starts ({len(tables) - 1})"
            handles.append(Line2D([], [], **style, linewidth=0.7, alpha=0.6, label=label))
        for ax, way in zip(axes, titles, strict=True):
            for n, table in enumerate(tables):
                if way in table:
                    width, alpha = (1.8, 1.0) if n == 0 else (0.7, 0.6)
                    ax.plot(table.index, table[way], linewidth=width, alpha=alpha, **style)
    for ax, way in zip(axes, titles, strict=True):
        ax.axhline(0, color=GREY, linewidth=0.6)
        dress(ax, x="distance (m)", title=titles[way])
    axes[0].set_ylabel("mean force, + apart, - together (N)", fontsize=9.0)
    legend_above(figure, handles, len(handles))
    return figure


def plot_acceleration_by_speed(tables: Mapping[str, pd.DataFrame]) -> Figure:
    """Mean acceleration along a person's own way by his speed; one panel per model.

    Args:
        tables: model to a table with the columns ``pair``, ``wall``, ``sum`` (m/s²) and ``n``
            (people), indexed by speed (m/s).
    """
    figure = new_figure(2.4 * len(tables) + 0.4, 3.2)
    axes = np.atleast_1d(figure.subplots(1, len(tables), sharey=True, sharex=True))
    lines: dict[str, tuple[str, str, Any]] = {
        "pair": ("from people", "vermillion", (0, (6, 2))),
        "wall": ("from walls", "blue", (0, (1.2, 1.4))),
        "sum": ("sum", "black", "-"),
    }
    for ax, (model, table) in zip(axes, tables.items(), strict=True):
        share = table["n"] / table["n"].max()
        twin = ax.twinx()
        twin.bar(table.index, share, width=0.09, color=SHADE, edgecolor="none")
        twin.set(ylim=(0, 4), yticks=[])
        twin.set_zorder(0)
        ax.set_zorder(1)
        ax.patch.set_visible(False)
        for part, (label, color, line) in lines.items():
            style = {"label": label, "color": OKABE_ITO[color], "linestyle": line}
            ax.plot(table.index, table[part], **style, linewidth=1.4)
        ax.axhline(0, color=GREY, linewidth=0.6)
        dress(ax, x="own speed (m/s)", title=model)
    axes[0].set_ylabel("mean acceleration along the own way (m/s²)", fontsize=SMALL_FONT)
    legend_above(figure, axes[0].get_legend_handles_labels()[0])
    return figure
