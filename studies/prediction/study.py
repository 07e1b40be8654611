"""Laws beside published predictions: people behind automated cars, and people in the open."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from nnode.calibrate.resampling import group_weights
from nnode.errors import ConfigError
from nnode.pages.page import Block, Heading, TableBlock, Text
from studies.options import PredictionStudyOptions
from studies.prediction import printed, tasks
from studies.prediction.data import AHEAD, SCENES, SEEN, STEP, stores
from studies.runner import Task, hash_of, run_tasks
from studies.walking import tasks as walking

TITLE = "Prediction: laws beside published figures"
SUBTITLE = (
    "People who follow automated cars, by the published metric, and people in open scenes, each "
    "scene predicted by laws that were calibrated on the other four."
)
#: Laws of car following, and laws of people with how the page calls them.
LAWS = ("idm", "fvdm", "ovm", "gipps", "helly", "newell")
PEOPLE = {"alone": "no interaction", "exponential": "social force", "esf": "elliptical force"}
#: Predictions that need no calibration.
SIMPLE = {
    "constant_velocity": "constant velocity",
    "preferred": "mean speed with the stream",
}
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
    assert options.workers is not None
    laws = LAWS[:2] if options.quick else LAWS
    people = list(PEOPLE)[: 1 if options.quick else None]
    held = SCENES[:1] if options.quick else SCENES
    found_stores = stores(options.source, folder / "data")
    folders = [str(found_stores[name].folder) for name in SCENES]
    every = [
        Task(
            f"follow-{law}",
            tasks.follow,
            {
                "law": law,
                "folder": str(found_stores["waymo_pairs"].folder),
                "starts": options.restarts,
                "seed": options.seed,
            },
        )
        for law in laws
    ]
    for name in held:
        where = {"folders": folders, "held": [name]}
        every.append(Task(f"simple-{name}", walking.baselines, where))
        every += [
            Task(
                f"{law}-{name}",
                walking.fit,
                {"law": law, "desired": "direction", **where},
                cost=10.0,
            )
            for law in people
        ]
    found = run_tasks(
        every,
        folder,
        workers=options.workers,
        fingerprint=hash_of(found_stores),
        title="prediction study",
    )
    return [*_following(found, laws, options.seed), *_walking(found, people, held)]


def _following(found: dict[str, Any], laws: tuple[str, ...], seed: int) -> list[Block]:
    rows: dict[str, dict[str, Any]] = {}
    for law in laws:
        sums = found[f"follow-{law}"]
        number = len(sums["test"]["error"])
        weights = group_weights(np.arange(number), DRAWS, np.random.default_rng(seed))
        low, high = np.quantile([tasks.rmspe(sums["test"], w) for w in weights], [0.025, 0.975])
        row = ", ".join(f"{name} = {value:.3g}" for name, value in sums["row"].items())
        rows[law] = {
            "training": tasks.rmspe(sums["train"]),
            "test": tasks.rmspe(sums["test"]),
            "low": low,
            "high": high,
            "parameters": row,
        }
    own = pd.DataFrame(rows).T
    best = min(laws, key=lambda law: float(rows[law]["training"]))
    test = float(rows["idm"]["test"])
    side = "below" if test < printed.IDM[1] else "above"
    published = {
        "idm, published": dict(zip(("training", "test"), printed.IDM, strict=True)),
        "learned, published": {"test": printed.LEARNED},
    }
    table = pd.concat([own, pd.DataFrame(published).T]).rename_axis("law")
    return [
        Heading("People behind automated cars"),
        Text(
            f"The intelligent driver model calibrated here has a test error of {test:.4f}, {side} "
            f"the {printed.IDM[1]:.4f} of the published calibration. Of the laws here, {best} has "
            f"the least training error; its test error is {float(rows[best]['test']):.4f}."
        ),
        TableBlock(
            "following",
            table,
            "Root mean square percentage error of spacings over all samples. Calibrated on the 71 "
            "training events by the same metric, tested on the 18 others; the interval of 95 % "
            "resamples test events. The learned model was chosen on the test events.",
            digits={"training": 4, "test": 4, "low": 4, "high": 4},
        ),
    ]


def _walking(found: dict[str, Any], people: list[str], held: tuple[str, ...]) -> list[Block]:
    errors: dict[str, dict[str, Any]] = {
        label: {scene: found[f"simple-{scene}"][key][scene] for scene in held}
        for key, label in SIMPLE.items()
    }
    errors |= {
        PEOPLE[law]: {scene: found[f"{law}-{scene}"]["errors"][scene] for scene in held}
        for law in people
    }
    tables = {}
    for what in ("ade", "fde"):
        tables[what] = pd.DataFrame(
            {label: {s: one[s][what] for s in held} for label, one in errors.items()}
        ).T
        place = ("ade", "fde").index(what)
        known = {s: printed.CONSTANT_VELOCITY[s][place] for s in held}
        tables[what].loc["constant velocity, published"] = known
    straight = SIMPLE["constant_velocity"]
    lines = []
    for law in people:
        better = tables["ade"].loc[PEOPLE[law]] < tables["ade"].loc[straight]
        said = (
            "predicts better than constant velocity in all scenes"
            if better.all()
            else f"is no better than constant velocity: better in {better.sum()} of {len(held)} "
            "scenes"
        )
        lines.append(f"- {PEOPLE[law].capitalize()} {said}.")
    number = {s: errors[straight][s]["people"] for s in held}
    return [
        Heading("People in open scenes"),
        Text("\n".join(lines)),
        Text(
            f"{SEEN} samples are seen and {AHEAD} predicted, {STEP:g} s apart, in consecutive "
            "windows: "
            + ", ".join(f"{n} people in {s}" for s, n in number.items())
            + ". The published figures are of all windows that begin at any sample. Everybody "
            "wants to walk as fast as he was seen to, in the direction of those who walk his way. "
            "Only people who are there throughout push others."
        ),
        TableBlock(
            "ade",
            tables["ade"],
            "Mean distance (m) between prediction and measurement.",
            bold=tables["ade"].eq(tables["ade"].iloc[:-1].min()),
            digits=3,
        ),
        TableBlock(
            "fde",
            tables["fde"],
            "Distance (m) at the last sample.",
            bold=tables["fde"].eq(tables["fde"].iloc[:-1].min()),
            digits=3,
        ),
    ]
