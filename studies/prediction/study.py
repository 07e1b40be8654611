"""Laws beside published predictions: people behind automated cars, and people in the open."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from nnode.calibrate.resampling import group_weights
from nnode.errors import ConfigError
from nnode.pages.page import Block
from studies.frame import computed
from studies.options import PredictionStudyOptions
from studies.page import page
from studies.prediction import printed, tasks
from studies.prediction.tasks import AHEAD, SCENES, SEEN, STEP, stores
from studies.runner import Task
from studies.walking import tasks as walking
from studies.walking.study import errors_by_run

TITLE = "Prediction: laws and published results"
SUBTITLE = (
    "Drivers behind automated cars, by the published metric, and pedestrians in open scenes, where "
    "each scene is predicted by laws that were calibrated on the other four."
)
#: Laws of car following, and laws of people with how the page calls them.
LAWS = ("idm", "fvdm", "ovm", "gipps", "helly", "newell")
PEOPLE = {"alone": "no interaction", "exponential": "social force", "esf": "elliptical force"}
#: Predictions that need no calibration.
SIMPLE = {"constant_velocity": "constant velocity", "preferred": "mean speed with the stream"}
#: Resamples of an interval.
DRAWS = 2000


def run(options: PredictionStudyOptions, folder: Path) -> list[Block]:
    """Compute what is missing and make the page.

    Raises:
        ConfigError: no folder with the files.
        DataError: files that are not there or cannot be read.
        StudyError: tasks failed.
    """
    if options.source is None:
        raise ConfigError(
            "study.source is not set; expected a folder with waymo_pairs and eth_ucy, whose files "
            "have no addresses of their own (NNODE_DATA in the environment sets it)"
        )
    prepared = stores(options.source, folder / "data")
    folders = [str(prepared[name].folder) for name in SCENES]
    pairs = {"folder": str(prepared["waymo_pairs"].folder), "seed": options.seed}
    every = [
        Task(f"follow-{law}", tasks.follow, {"law": law, "starts": options.restarts, **pairs})
        for law in LAWS[: 2 if options.quick else None]
    ]
    for name in SCENES[: 1 if options.quick else None]:
        where: dict[str, Any] = {"folders": folders, "held": [name]}
        every.append(Task(f"simple-{name}", walking.baselines, where))
        for law in list(PEOPLE)[: 1 if options.quick else None]:
            arguments = {"law": law, "desired": "direction", **where}
            every.append(Task(f"{law}-{name}", walking.fit, arguments, cost=10.0))
    results = computed(every, folder, options, prepared, "prediction study")
    distances = errors_by_run(results["errors"].dropna(), SIMPLE | PEOPLE)
    return page(
        "prediction",
        stores=prepared.values(),
        following=following(results, options.seed),
        ade=by_scene(distances, "ade"),
        fde=by_scene(distances, "fde"),
        people=distances.groupby("run", sort=False)["people"].first().to_dict(),
        seen=SEEN,
        ahead=AHEAD,
        step=STEP,
    )


def following(results: pd.DataFrame, seed: int) -> pd.DataFrame:
    """Errors of spacings by law, published ones last."""
    rows: dict[str, dict[str, Any]] = {}
    for task in results.query("task == 'follow'").to_dict("records"):
        test = task["test"]
        clusters = np.arange(len(test["error"]))
        weights = group_weights(clusters, DRAWS, np.random.default_rng(seed))
        low, high = np.quantile([tasks.rmspe(test, w) for w in weights], [0.025, 0.975])
        rows[task["law"]] = {
            "training": tasks.rmspe(task["train"]),
            "test": tasks.rmspe(test),
            "low": low,
            "high": high,
            "parameters": ", ".join(f"{name} = {value:.3g}" for name, value in task["row"].items()),
        }
    rows["idm, published"] = dict(zip(("training", "test"), printed.idm, strict=True))
    rows["learned, published"] = {"test": printed.learned}
    return pd.DataFrame.from_dict(rows, orient="index").rename_axis("law")


def by_scene(distances: pd.DataFrame, what: str) -> pd.DataFrame:
    """A distance (m) by law and held-out scene, the published one last."""
    order = distances["law"].unique(), distances["run"].unique()
    table = distances.pivot(index="law", columns="run", values=what).loc[*order]
    place = ("ade", "fde").index(what)
    told = {scene: printed.constant_velocity[scene][place] for scene in map(str, table)}
    table.loc["constant velocity, published"] = pd.Series(told)
    return table.rename_axis(index=None, columns=None)
