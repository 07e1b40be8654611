"""The crowd study's section on conventions: how far open choices carry to the printed costs."""

from __future__ import annotations

from itertools import product

import numpy as np
import pandas as pd

from nnode.pages.page import Block, Heading, TableBlock, Text
from studies.crowd.conventions import EVERY, Convention, key
from studies.crowd.printed import COSTS
from studies.crowd.results import Crowd

#: Conventions, besides the study's own, in which networks are calibrated: those nearest to the
#: printed cost.
NEAREST = 2
#: The networks without and with the summand j = i.
NETWORKS = {"nn": "j ≠ i", "nn_self": "all j"}

_LEVELS = ["velocity", "samples", "destination"]


def scans(study: Crowd) -> pd.DataFrame:
    """A row per convention and first frame: ``printed`` (m²), ``people``, and what is the same
    for all first frames: ``first``, ``relaxation`` and ``sf`` (m²)."""
    rows = []
    for how in EVERY:
        found = study.found[key(how)]
        for offset, cost, people in zip(
            found["offsets"], found["printed"], found["people"], strict=True
        ):
            rows.append(
                (
                    how.velocity,
                    how.samples,
                    how.destination,
                    offset,
                    cost,
                    people,
                    found["printed"][0],
                    found["relaxation"],
                    found["sf"],
                )
            )
    columns = [*_LEVELS, "offset", "printed", "people", "first", "relaxation", "sf"]
    return pd.DataFrame(rows, columns=columns).set_index([*_LEVELS, "offset"])


def to_calibrate(study: Crowd) -> list[Convention]:
    """The study's own convention, and those that come nearest to the printed cost of SF."""
    own = Convention()
    away = {
        how: abs(study.found[key(how)]["printed"][0] - COSTS["sf"]) for how in EVERY if how != own
    }
    return [own, *sorted(away, key=lambda how: away[how])[:NEAREST]]


def network_key(how: Convention, model: str, seed: int) -> str:
    """Of the task that calibrates networks in a convention."""
    return f"{key(how)}-{model}-{seed}"


def conventions(study: Crowd) -> list[Block]:
    """The section: costs by convention, means, networks, and what follows from them."""
    every = scans(study)
    table, means, networks = _table(every), _means(every, study.step), _networks(study)
    inside = (table["from"] <= COSTS["sf"]) & (COSTS["sf"] <= table["to"])
    bold = pd.DataFrame(False, table.index, table.columns)
    bold.loc[inside, ["from", "to"]] = True
    lines = [_nearest(table), _reached(means), _verdict(table, networks)]
    return [
        Heading("Conventions that the paper leaves open"),
        Text(
            "The velocity at the start is *a finite difference*; a sequence has *25 time steps*, "
            "which are 25 or 26 samples; the destination is *the last position of the data "
            "sequence*, whose person's trajectory may end later. All of these are set against "
            "each other here, with cutting begun at every frame of the first second. The "
            "printed parameters are simulated as they are; the social force is calibrated where "
            "cutting begins with the first frame.\n\n" + "\n".join(f"- {line}" for line in lines)
        ),
        TableBlock(
            "crowd_conventions",
            table,
            "Mean cost of a sequence without the time step, m²: printed parameters, cut from the "
            "first frame, and least and greatest over all first frames; without interaction; "
            f"calibrated. Bold: the printed {COSTS['sf']} lies between. *mean* is the mean "
            "velocity of the sequence, *none* lets everyone start at rest, so that he stays "
            "there: the relaxation keeps a speed of 0.",
            bold=bold,
            digits=3,
            full=every.rename(columns={"first": "printed, first frame"}),
        ),
        TableBlock(
            "crowd_conventions_means",
            means,
            "What the same costs are in other means: least and greatest over all conventions in "
            f"which people move, and how many and which have {COSTS['sf']} between the least and "
            "the greatest over their first frames. The paper's formula has the factor 1/2 and the "
            "time step.",
            digits={"least": 3, "greatest": 3},
        ),
        TableBlock(
            "crowd_conventions_networks",
            networks,
            "The networks, without and with the person himself in the sum (j = i), in the "
            "study's own convention and in those that come nearest to the printed J_SF: least "
            f"and greatest cost of the starts, m², to be set beside the printed {COSTS['nn']}.",
            digits=3,
        ),
    ]


def _table(every: pd.DataFrame) -> pd.DataFrame:
    groups = every.groupby(level=_LEVELS, sort=False)
    return pd.DataFrame(
        {
            "printed parameters": groups["first"].first(),
            "from": groups["printed"].min(),
            "to": groups["printed"].max(),
            "relaxation alone": groups["relaxation"].first(),
            "SF calibrated": groups["sf"].first(),
        }
    )


def _means(every: pd.DataFrame, step: float) -> pd.DataFrame:
    """A row per mean: the printed number against the costs of all moving conventions."""
    rows, moving = {}, every[every.index.get_level_values("velocity") != "none"]
    for half, time, person in product((True, False), (False, True), (False, True)):
        value = moving["printed"] * (1 if half else 2) * (step if time else 1)
        value = value / moving["people"] if person else value
        groups = value.groupby(level=_LEVELS, sort=False)
        between = (groups.min() <= COSTS["sf"]) & (COSTS["sf"] <= groups.max())
        label = (
            *("yes" if on else "no" for on in (half, time)),
            "person" if person else "sequence",
        )
        rows[label] = {
            "least": value.min(),
            "greatest": value.max(),
            "around": int(between.sum()),
            "which": "; ".join(str(Convention(*at)) for at in between.index[between]) or "–",
        }
    found = pd.DataFrame.from_dict(rows, orient="index")
    found.index = pd.MultiIndex.from_tuples(rows, names=["factor 1/2", "time step", "mean over"])
    return found


def _networks(study: Crowd) -> pd.DataFrame:
    rows = {}
    for how in to_calibrate(study):
        for model, label in NETWORKS.items():
            prefix = network_key(how, model, 0)[:-1]
            found = [value["J"] for name, value in study.found.items() if name.startswith(prefix)]
            scan = study.found[key(how)]
            rows[(*vars(how).values(), label)] = {
                "NN, least": min(found),
                "NN, greatest": max(found),
                "SF calibrated": scan["sf"],
                "relaxation alone": scan["relaxation"],
            }
    return pd.DataFrame(rows).T.rename_axis([*_LEVELS, "sum over"])


def _nearest(table: pd.DataFrame) -> str:
    cost = table["printed parameters"].to_numpy()
    away = cost / COSTS["sf"] - 1
    at = int(np.abs(away).argmin())
    return (
        f"Cut from the first frame, the printed parameters come nearest to the printed "
        f"J_SF = {COSTS['sf']} with *{EVERY[at]}*: {cost[at]:.4f} m² ({away[at]:+.1%}); the "
        f"study's own convention, *{Convention()}*, is off by "
        f"{away[EVERY.index(Convention())]:+.1%}."
    )


def _reached(means: pd.DataFrame) -> str:
    number = means["around"]
    ways = int(number.sum())
    if not ways:
        return (
            "No combination of convention and mean has the printed J_SF between its costs: it "
            "stays unexplained."
        )
    return (
        f"With the first frame free, {ways} combinations of convention and mean have the printed "
        "J_SF between their costs: it is within reach, but does not tell which of them the paper "
        "used."
    )


def _verdict(table: pd.DataFrame, networks: pd.DataFrame) -> str:
    """Whether any convention can have both printed costs as minima."""
    moving = table[table.index.get_level_values("velocity") != "none"]
    ratio = moving[["printed parameters", "SF calibrated"]].div(moving["relaxation alone"], axis=0)
    least = float(ratio.min().min())
    bound = COSTS["sf"] / least
    text = (
        f"The social force lowers the relaxation's cost by at most {1 - least:.1%}: where J_SF is "
        f"{COSTS['sf']}, the relaxation alone has at most {bound:.3f} m². "
    )
    if bound < COSTS["nn"]:
        text += (
            "Networks whose weights are zero, which the paper's box admits, are the relaxation "
            f"alone. So the printed J_NN = {COSTS['nn']} is no minimum in any of these "
            "conventions, but where a search stopped; "
        )
    else:
        text += f"This leaves room for the printed J_NN = {COSTS['nn']}; "
    off = networks["NN, least"] / networks["relaxation alone"] - 1
    return text + (
        f"the best networks calibrated here differ from the relaxation by {float(off.min()):+.0%} "
        f"to {float(off.max()):+.0%}."
    )
