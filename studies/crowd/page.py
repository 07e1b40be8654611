"""The page of the crowd study. Every claim in its text is computed from the results."""

from __future__ import annotations

import numpy as np
import pandas as pd

from nnode.calibrate.resampling import Paired
from nnode.pages.page import Block, FigureBlock, Heading, Provenance, TableBlock, Text
from studies.crowd import printed
from studies.crowd.data import ALL, GROUP, RECORDING, sequences
from studies.crowd.figures import horizon_costs
from studies.crowd.fit import NAMES
from studies.crowd.page_conventions import conventions
from studies.crowd.page_forces import force_blocks, restart_blocks
from studies.crowd.results import LABELS, MODELS, SIMPLE, Crowd
from studies.replay import player, scenes, spread

#: Models in the player, and how many sequences.
SHOWN, FEW = ("sf", "nn"), 8


def blocks(study: Crowd) -> list[Block]:
    """The page in its order."""
    every = study.every_parameter()
    files = {
        file["name"]: file["sha256"]
        for store in study.stores.values()
        for file in store.manifest["files"].values()
    }
    return [
        *_summary(study),
        *_data(study),
        *_parameters(study),
        *_costs(study),
        *conventions(study),
        *_heldout(study),
        *_others(study),
        *restart_blocks(study),
        *force_blocks(study),
        *_replay(study),
        TableBlock(
            "parameters",
            every.head(6),
            "Every calibration, one row per number; the first rows are shown, the CSV holds all "
            "of them, so that anyone can compute the costs again.",
            digits=4,
            full=every,
        ),
        Provenance({f"SHA-256 of {name}": value for name, value in files.items()}),
    ]


def verdict(first: str, second: str, found: Paired) -> str:
    """What a paired comparison says, in words."""
    change = f"difference {found.difference:+.4f} m² s, 95 % {found.low:+.4f} to {found.high:+.4f}"
    if found.high < 0:
        return f"{first} is below {second} ({change})"
    if found.low > 0:
        return f"{first} is above {second} ({change})"
    return f"{first} and {second} cannot be told apart ({change})"


def _seconds(horizon: float) -> str:
    return f"{horizon:g} s"


def _summary(study: Crowd) -> list[Block]:
    first = study.horizons[0]
    sums = {m: _sum(study, m, first) for m in (*MODELS, "relaxation")}
    lines = [
        f"In the paper's convention and with all sequences of {_seconds(first)} training, "
        f"J_SF = {sums['sf']:.3f} and J_NN = {sums['nn']:.3f} m² (printed: "
        f"{printed.COSTS['sf']} and {printed.COSTS['nn']}); the relaxation without any "
        f"interaction has {sums['relaxation']:.3f}."
    ]
    if sums["relaxation"] < min(printed.COSTS.values()):
        lines.append(
            "Both printed costs lie above that of no interaction here, so that the paper's "
            "sequences or velocities must differ from those cut here as it describes; see "
            "[the conventions that it leaves open](#table-crowd_conventions)."
        )
    parameters = study.parameters()
    for name in NAMES:
        row = parameters.loc[f"here, {first:g} s"]
        inside = row[f"{name}, low"] <= printed.PARAMETERS[name] <= row[f"{name}, high"]
        lines.append(
            f"{name} = {row[name]:.4g} (95 %: {row[f'{name}, low']:.3g} to "
            f"{row[f'{name}, high']:.3g}) at {_seconds(first)}; the printed "
            f"{printed.PARAMETERS[name]:g} is {'inside' if inside else 'outside'} the interval."
        )
    lines.append(_nearest(study))
    for horizon in study.horizons:
        found = study.compare("nn", "sf", horizon)
        lines.append(f"Held out, {_seconds(horizon)}: {verdict('NN', 'SF', found)}.")
    lines.append(_pairs_matter(study))
    return [Heading("What comes out"), Text("\n".join(f"- {line}" for line in lines))]


def _nearest(study: Crowd) -> str:
    """The length at which the parameters come closest to the printed ones."""
    told = np.array([printed.PARAMETERS[name] for name in NAMES])
    away = {h: np.array(study.chosen("sf", ALL, h).row) / told - 1 for h in study.horizons}
    horizon = min(away, key=lambda h: float(np.abs(away[h]).max()))
    each = ", ".join(
        f"{name} {value:+.0%}" for name, value in zip(NAMES, away[horizon], strict=True)
    )
    return f"Closest to the printed parameters are those of {_seconds(horizon)}: {each}."


def _pairs_matter(study: Crowd) -> str:
    """Whether the network that lets people act on each other is any better for it."""
    gain = {h: study.compare("nn", "wall", h) for h in study.horizons}
    better = [h for h, found in gain.items() if found.high < 0]
    worse = [h for h, found in gain.items() if found.low > 0]
    text = (
        "The network of the walls alone, in which people do not act on each other and which sees "
        "only a person's own place and velocity, is "
    )
    beats = [h for h in study.horizons if study.compare("wall", "sf", h).high < 0]
    text += f"below SF at {', '.join(map(_seconds, beats))}. " if beats else "nowhere below SF. "
    if better:
        text += (
            f"Forces between people lower NN's held-out cost at {', '.join(map(_seconds, better))}"
        )
        text += f" and raise it at {', '.join(map(_seconds, worse))}." if worse else "."
    elif worse:
        text += (
            f"Forces between people raise the held-out cost at {', '.join(map(_seconds, worse))}."
        )
    else:
        text += "Forces between people change NN's held-out cost at no horizon significantly."
    if beats and not better:
        text += (
            " What NN gains over SF is therefore no interaction but a correction of the "
            "relaxation by own speed and place."
        )
    return text


def _sum(study: Crowd, model: str, horizon: float) -> float:
    """Mean cost of a sequence without the time step, m²."""
    return float(study.all_costs(model, horizon).mean()) / study.step


def _data(study: Crowd) -> list[Block]:
    rows = {}
    for (part, horizon), store in study.stores.items():
        name = RECORDING if part == "main" else "other two-way runs"
        people = [entry["n_agents"] for entry in store.index]
        rows[(name, f"{horizon:g} s")] = {
            "sequences": len(people),
            "left out as faulty": store.manifest["counts"]["dropped"],
            "people, mean": float(np.mean(people)),
            "people, most": max(people),
        }
    table = pd.DataFrame(rows).T.astype(
        {"sequences": int, "left out as faulty": int, "people, most": int}
    )
    table.index.names = ["recording", "length"]
    width = (study.span[1] - study.span[0]) / study.options.folds
    return [
        Heading("Data"),
        Text(
            "Recordings are cut into consecutive sequences. Only people who are tracked during a "
            "whole sequence are part of it, so that longer sequences hold fewer and slower "
            "people: costs of different lengths are not of the same people. Everyone's "
            "destination is his own last position in the sequence, as in the paper: all models "
            "are told where everyone ends, though not when, and over one second this explains "
            f"nearly everything. The baseline *{LABELS['even_pace']}* shows how much such "
            "knowledge is worth: it walks everyone straight to that place, in time.\n\n"
            f"For held-out costs the recording is divided into {study.options.folds} blocks of "
            f"{width:.1f} s, the same at every length. Each block is held out in turn; sequences "
            "that share a person with it, or lie across a border, do not train. Nothing is chosen "
            "by a held-out cost: among several starts the least training cost decides. Intervals "
            f"resample stretches of {GROUP:g} s."
        ),
        TableBlock("crowd_data", table, "Sequences by length.", digits=1),
    ]


def _parameters(study: Crowd) -> list[Block]:
    table = study.parameters()
    table.columns = [
        name.replace("kappa", "κ").replace(", low", " from").replace(", high", " to")
        for name in map(str, table)
    ]
    text = (
        "A (N), k (kg/s²) and κ (kg/(m s)) are calibrated within A, k, κ ≥ 0 from starts uniform "
        "on [0, 50]³, by Levenberg and Marquardt's method; each start first meets the first "
        "samples of every sequence, then more and more of them. Intervals are percentiles of "
        f"{study.options.bootstrap} refits to resampled stretches of time."
    )
    return [
        Heading("Parameters of the social force"),
        Text(text),
        TableBlock(
            "crowd_parameters",
            table,
            "A in N, k in kg/s², κ in kg/(m s), with 95 % intervals; printed values first.",
            digits={name: 4 if name.startswith("A") else 1 for name in map(str, table)},
        ),
    ]


def _costs(study: Crowd) -> list[Block]:
    first = study.horizons[0]
    rows = {}
    for model in (*MODELS, *SIMPLE):
        costs = study.all_costs(model, first)
        low, high = study.interval(costs, first)
        rows[LABELS[model]] = {
            "printed (m²)": printed.COSTS.get(model, np.nan),
            "here (m²)": float(costs.mean()) / study.step,
            "here (m² s)": float(costs.mean()),
            "from": low,
            "to": high,
        }
    table = pd.DataFrame(rows).T
    bold = pd.DataFrame(False, table.index, table.columns)
    models = [LABELS[m] for m in MODELS]
    for name in ("here (m²)", "here (m² s)"):
        bold.loc[table.loc[models, name].idxmin(), name] = True
    return [
        Heading("Costs"),
        Text(
            "The printed costs have no time step in them (m²); the cost in m² s is "
            f"{study.step:g} s times that. All sequences train here, as in the paper."
        ),
        TableBlock(
            "crowd_costs",
            table,
            f"Mean cost of a sequence of {_seconds(first)}, all sequences training, with the 95 % "
            "interval of the cost in m² s. Least of the calibrated models in bold.",
            bold=bold,
            digits={"printed (m²)": 4, "here (m²)": 3, "here (m² s)": 4, "from": 4, "to": 4},
        ),
    ]


def _heldout(study: Crowd) -> list[Block]:
    tables = {
        "training": study.by_horizon(heldout=False),
        "held out": study.by_horizon(heldout=True),
    }
    both = (
        pd.concat(tables, names=["", "model"]).swaplevel().sort_index(level=0, sort_remaining=False)
    )
    order = [(LABELS[m], part) for m in (*MODELS, *SIMPLE) for part in tables]
    both = both.reindex(order)
    bold = pd.DataFrame(False, both.index, both.columns)
    models = [LABELS[m] for m in MODELS]
    for column in map(_seconds, study.horizons):
        for part, table in tables.items():
            bold.loc[(str(table.loc[models, column].idxmin()), part), column] = True
    shown = ("relaxation", *MODELS, "constant_velocity", "even_pace")
    ends: dict[str, dict[str, tuple[float, float]]] = {}
    for model in shown:
        ends[LABELS[model]] = {
            _seconds(h): study.interval(study.heldout(model, h), h) for h in study.horizons
        }
    frame = pd.DataFrame(ends).T
    rank = tables["held out"].loc[[LABELS[m] for m in shown]]
    comparisons = []
    for horizon in study.horizons:
        for a, b in (("sf", "relaxation"), ("nn", "sf"), ("nn", "wall")):
            found = study.compare(a, b, horizon)
            comparisons.append(
                f"{_seconds(horizon)}: {verdict(LABELS[a], LABELS[b], found)}; "
                f"lower in {found.better:.0%} of the sequences."
            )
    return [
        Heading("Longer horizons, held-out time"),
        Text(
            "Networks and social force are calibrated anew for each length, from what the shorter "
            "one found. *Training* has all sequences training and tested; *held out* has each "
            "sequence under models that trained without its block of time."
        ),
        TableBlock(
            "crowd_horizons",
            both,
            "Mean cost of a sequence (m² s) by length. Least of the calibrated models in bold; "
            "baselines are the same in both rows but for the sequences across borders.",
            bold=bold,
            digits=4,
        ),
        FigureBlock(
            "crowd_horizons",
            horizon_costs(
                study.horizons, rank, frame.map(lambda e: e[0]), frame.map(lambda e: e[1])
            ),
            "Held-out cost relative to that of the relaxation alone; below 1, something is "
            "gained. Bars: 95 % intervals of the cost, which the models share in large part, so "
            "that differences are more certain than the bars suggest.",
            "Lines of relative held-out cost over the length of a sequence, one per model and "
            "baseline.",
        ),
        Text("Paired by sequence:\n\n" + "\n".join(f"- {line}" for line in comparisons)),
        *_blocks(study),
    ]


def _least(table: pd.DataFrame) -> pd.DataFrame:
    """Which of the calibrated models has the least cost in each row."""
    models = [LABELS[m] for m in MODELS]
    bold = pd.DataFrame(False, table.index, table.columns)
    for name in models:
        bold[name] = table[name] == table[models].min(axis=1)
    return bold


def _blocks(study: Crowd) -> list[Block]:
    """In which block of time a model fails."""
    table = study.blocks()
    above = (table[LABELS["nn"]] > table[LABELS["sf"]]).to_numpy()
    people = table["people"]
    mean = people.groupby(level="horizon").transform("mean").to_numpy()
    told = [
        f"block {block} at {horizon} ({number:.0f} people)"
        for (horizon, block), number in zip(table.index[above], people[above], strict=True)
    ]
    text = "NN is below SF in every block of time at every length."
    if told:
        text = f"NN is above SF in {', '.join(told)}."
    if told and bool((people.to_numpy() < mean)[above].all()):
        text += (
            " These blocks hold fewer people than the others: what the networks learned in the "
            "crowd does not carry over to times when the corridor is emptier."
        )
    return [
        Text(text),
        TableBlock(
            "crowd_blocks",
            table,
            "Mean held-out cost of a sequence (m² s) by block of time, with people's mean speed "
            "(m/s). Least of the calibrated models in bold.",
            bold=_least(table),
            digits={**dict.fromkeys(map(str, table), 4), "people": 1, "speed": 2},
        ),
    ]


def _others(study: Crowd) -> list[Block]:
    table = study.other_runs()
    sf, nn, none = (table[LABELS[m]] for m in ("sf", "nn", "relaxation"))
    lines = []
    for horizon in study.horizons:
        at = table.index.get_level_values(0) == f"{horizon:g} s"
        lines.append(
            f"{_seconds(horizon)}: of {int(at.sum())} runs, NN is below SF in "
            f"{int((nn < sf)[at].sum())}, SF below no interaction in "
            f"{int((sf < none)[at].sum())}, NN below no interaction in "
            f"{int((nn < none)[at].sum())}."
        )
    return [
        Heading("Other runs"),
        Text(
            "Models that trained on all sequences of the paper's recording, on six runs in "
            "corridors of 3.0 and 3.6 m at 16 frames/s. The corridors are turned so that people "
            "walk along x, because networks see directions. Nothing is calibrated on these "
            "runs.\n\n" + "\n".join(f"- {line}" for line in lines)
        ),
        TableBlock(
            "crowd_heldout_runs",
            table,
            "Mean cost of a sequence (m² s) in runs of other widths and densities, with people's "
            "mean speed (m/s). Least of the calibrated models in bold.",
            bold=_least(table),
            digits={**dict.fromkeys(map(str, table), 3), "people": 1, "speed": 2},
        ),
    ]


def _replay(study: Crowd) -> list[Block]:
    horizon = study.horizons[-1]
    every = sequences(study.folder("main", horizon))
    systems = {LABELS[m]: study.chosen(m, ALL, horizon).system for m in SHOWN}
    what = (
        f"Some sequences of {_seconds(horizon)} of the paper's recording, beside "
        f"{' and '.join(systems)} as calibrated to all of them."
    )
    found = scenes(spread(every, FEW), systems)
    return [Heading("Replay"), player("replay", found, what, len(every))]
