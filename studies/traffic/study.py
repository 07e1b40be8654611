"""Section 5 of the paper: five models on ten recordings, and what the paper leaves open."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pandas as pd

from nnode.data.options import Faults
from nnode.data.prepare import prepare
from nnode.data.readers.esimas import EsimasOptions
from nnode.data.store import Store
from nnode.errors import ConfigError
from nnode.pages.page import Block
from studies.frame import computed
from studies.options import TrafficStudyOptions
from studies.page import page
from studies.runner import Task
from studies.traffic import printed, tasks
from studies.traffic.results import GRADIENT, LAWS, MODELS, NETWORKS, Study

TITLE = "Traffic: five models on ten recordings"
SUBTITLE = (
    "Section 5 of Göttlich & Totzeck, *Optimal control for interacting particle systems driven "
    "by neural networks*, on the same recordings, with the published values."
)

#: Relative time of a gradient.
_TIMES = {"lin": 1.0, "log": 1.2, "n2": 1.5, "n4": 2.0, "n10": 3.5}
#: A recording is searched with up to so many times the starts of the largest one.
_MOST = 12
#: Sampling interval of the recordings, s.
SAMPLING = 0.2
#: Other steps at which solutions are evaluated, s.
STEPS = [0.2, 0.1, 0.05, 0.02, 0.01, 0.005, 0.001]


def run(options: TrafficStudyOptions, folder: Path) -> list[Block]:
    """Compute what is missing and make the page.

    Raises:
        ConfigError: an option out of its range.
        DataError: recordings that cannot be read.
        StudyError: tasks failed.
    """
    for name in ("dt", "descent_dt"):
        step = getattr(options, name)
        if step > SAMPLING or abs(SAMPLING / step - round(SAMPLING / step)) > 1e-6:
            raise ConfigError(
                f"study.{name}={step} s must divide the sampling interval of {SAMPLING} s"
            )
    stores = {policy: _prepared(options, policy, folder) for policy in ("keep", "drop")}
    every = list(_tasks(options, stores))
    results = computed(every, folder, options, stores, "traffic study")
    repeats = {} if options.quick else wider(every, results["cost"])
    if repeats:
        wide = computed(list(repeats.values()), folder, options, stores, "wider search")
        wide = wide.set_axis(list(repeats)).assign(before=results["cost"])
        wide = wide[wide["cost"] < wide["before"]]
        results = pd.concat([results.drop(wide.index), wide]).loc[results.index]
    study = Study(options, stores, results)
    return page("traffic", study, [stores["keep"]], gradient=GRADIENT)


def wider(every: list[Task], costs: Any) -> dict[str, Task]:
    """Twice the search, from other starts, by the task whose printed cost of a network is lower."""
    repeats = {}
    for task in every:
        how = task.arguments
        if not task.key.startswith("fit-keep-") or how["box"] or how["model"] in LAWS:
            continue
        theirs = printed.costs[how["model"]][printed.recordings.index(how["recording_name"])]
        if theirs < costs[task.key]:
            twice = {key: 2 * how[key] for key in ("restarts", "iterations")}
            arguments = {**how, **twice, "seed": how["seed"] + 1}
            key = task.key.replace("fit-", "wider-", 1)
            repeats[task.key] = Task(key, tasks.fit, arguments, 4 * task.cost)
    return repeats


def _prepared(options: TrafficStudyOptions, policy: str, folder: Path) -> Store:
    # one folder for both policies, so that nothing is fetched twice
    download = options.download or str(folder / "data" / "raw")
    chosen = EsimasOptions(
        name="esimas", source=options.source, download=download, faults=Faults(policy)
    )
    return prepare(chosen, folder / "data" / policy)


def _tasks(options: TrafficStudyOptions, stores: dict[str, Store]) -> Iterator[Task]:
    """Model × recording × treatment of faults: fits, held-out costs, the paper's optimiser."""
    for policy, store in stores.items():
        # the time of a gradient goes with the measured positions of followers
        index = pd.DataFrame(store.index)
        positions = (index["n_agents"] - 1) * index["n_samples"]
        sizes = positions.groupby(index["recording"], sort=False).sum()
        for name, size in sizes.items():
            # as much time for a small recording as for the largest: it has as many minima
            share = min(_MOST, sizes.max() / size)
            for model in MODELS:
                where: dict[str, Any] = {"folder": str(store.folder), "recording_name": name}
                where |= {"model": model, "dt": options.dt, "seed": options.seed}
                yield from _of_model(options, policy, where, _TIMES[model] * size, share)


def _of_model(
    options: TrafficStudyOptions, policy: str, where: dict[str, Any], time: float, share: float
) -> Iterator[Task]:
    model, place = where["model"], f"{where['recording_name']}-{where['model']}"
    for box in (None, options.box) if model in NETWORKS else (None,):
        suffix = "" if box is None else "-box"
        # laws have two parameters: few starts find what there is
        starts = options.restarts / (4 if model in LAWS or box else _TIMES[model] / _TIMES["n4"])
        starts /= 2 if policy == "drop" else 1
        if box is None or policy == "keep":
            search: dict[str, Any] = {
                "box": box,
                "restarts": max(2, round(starts * share)),
                "iterations": options.iterations,
                "bootstrap": options.bootstrap if box is None else 0,
                "steps": STEPS,
            }
            yield Task(f"fit-{policy}-{place}{suffix}", tasks.fit, where | search, 3 * time)
        search = {
            "box": box,
            "restarts": max(2, options.restarts // 4),
            "iterations": max(20, options.iterations * 2 // 3),
            "folds": options.folds,
        }
        key = f"heldout-{policy}-{place}{suffix}"
        yield Task(key, tasks.cross_validate, where | search, 3 * time)
    if policy == "drop":
        return
    descent = {
        "restarts": 2,
        "steps": options.descent_steps,
        "updates_dt": options.descent_dt,
        "lr": options.descent_lr,
        "batch_size": options.batch_size,
    }
    yield Task(f"descent-{place}", tasks.descend, where | descent, 2 * time)
    if model in LAWS:
        scan = {k: v for k, v in where.items() if k != "seed"}
        scan["points"] = 21 if options.quick else 81
        yield Task(f"scan-{place}", tasks.scan, scan, time)
