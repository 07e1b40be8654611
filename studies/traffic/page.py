"""The page of the traffic study. Every claim in its text is computed from the results."""

from __future__ import annotations

import numpy as np
import pandas as pd

from nnode.calibrate.resampling import average_interval
from nnode.pages.page import Block, FigureBlock, Heading, Provenance, TableBlock, Text
from nnode.plots.traffic import measured_gaps
from studies.replay import player, scenes, spread
from studies.traffic import printed
from studies.traffic.faults import fault_blocks
from studies.traffic.figures import law_panels, leader_speeds
from studies.traffic.heldout import heldout_blocks
from studies.traffic.optimizers import optimizer_blocks
from studies.traffic.problem import GAPS, system_of
from studies.traffic.results import (
    AVERAGE,
    KMH,
    LAWS,
    NETWORKS,
    ORDER,
    Study,
    averaged,
    cell,
    least,
    printed_costs,
    printed_lengths,
)

#: Models in the player, and how many sequences of each recording.
SHOWN, FEW = ("lin", "n2"), 4


def blocks(study: Study) -> list[Block]:
    """The page in its order."""
    return [
        *_summary(study),
        *_data(study),
        *_lengths(study),
        *_costs(study),
        *_speeds(study),
        *_laws(study),
        *heldout_blocks(study),
        *optimizer_blocks(study),
        *fault_blocks(study),
        *_replay(study),
        TableBlock(
            "parameters",
            study.parameters().head(8),
            "Every calibrated run, one row per number; the first rows are shown, the CSV holds "
            "all of them, so that anyone can compute the costs again.",
            full=study.parameters(),
            digits=4,
        ),
        Provenance(
            {
                f"SHA-256 of {file['name']}": file["sha256"]
                for file in study.stores["keep"].manifest["files"].values()
            }
        ),
    ]


def _both(ours: pd.DataFrame, theirs: pd.DataFrame) -> pd.DataFrame:
    """Our rows, the printed ones and the differences, one under the other by model."""
    rows = {}
    for model in ours.index:
        rows[(model, "here")] = ours.loc[model]
        rows[(model, "printed")] = theirs.loc[model]
        rows[(model, "difference")] = ours.loc[model] - theirs.loc[model]
    return pd.DataFrame(rows).T.rename_axis(["model", ""])


def _summary(study: Study) -> list[Block]:
    costs = study.costs()
    box = study.costs(suffix="-box")[AVERAGE]
    rows = {}
    for model in ORDER:
        each = [study.one("fit", name, model) for name in study.recordings()]
        low, high = average_interval(
            [np.array(one["costs"]) for one in each],
            [np.array(one["groups"]) for one in each],
            study.options.seed,
        )
        rows[model] = {
            "printed": printed.AVERAGE_COSTS[model],
            "here": cell(costs, model, AVERAGE),
            "95 % low": low,
            "95 % high": high,
            "paper's optimiser": cell(study.costs("descent"), model, AVERAGE),
            "consensus": cell(study.costs("consensus"), model, AVERAGE),
            "weights in box": box.get(model, np.nan),
            "faults dropped": cell(study.costs(policy="drop"), model, AVERAGE),
        }
    table = pd.DataFrame(rows).T.rename_axis("model")
    best = str(table["here"].idxmin())
    below = [m for m in ORDER if cell(table, m, "here") < cell(table, m, "printed")]
    said = "all five models" if len(below) == len(ORDER) else ", ".join(below) or "no model"
    text = (
        f"Averaged over ten recordings, {said} reach a lower cost here than printed; the least "
        f"is {best}'s, {cell(table, best, 'here'):.2f} m² s. The intervals come from resampling "
        "groups of sequences that may share vehicles."
    )
    bold = pd.DataFrame(False, index=table.index, columns=table.columns)
    bold.loc[best, "here"] = True
    return [
        Heading("In short"),
        Text(text),
        TableBlock(
            "averages",
            table,
            "Cost J (m² s), mean over the ten recordings. *Here*: best of many starts by "
            f"projected BFGS, weights free. *Box*: weights kept in [-{study.options.box:g}, "
            f"{study.options.box:g}]. *Paper's optimiser*: {study.options.descent_steps} updates, "
            "better of two runs. Faults of the measurement kept, except in the last column.",
            bold=bold,
        ),
    ]


def _data(study: Study) -> list[Block]:
    kept = study.stores["keep"].manifest["recordings"]
    dropped = study.stores["drop"].manifest["recordings"]
    rows = {}
    for number, name in enumerate(study.recordings(), 1):
        sequences = study.sequences(name)
        rows[number] = {
            "recording": name,
            "sequences": kept[name]["kept"],
            "without faults": dropped[name]["kept"],
            "groups": int(max(study.one("fit", name, "lin")["groups"])) + 1,
            "vehicles": sum(s.n_agents for s in sequences),
            "longest (s)": max(s.time[-1] - s.time[0] for s in sequences),
        }
    table = pd.DataFrame(rows).T.rename_axis("number")
    return [
        Heading("Data"),
        TableBlock(
            "recordings",
            table,
            "The ten ESIMAS recordings, sampled every 0.2 s. Sequences closer than 5 s in time may "
            "share vehicles; such groups are resampled and held out together. A recording of few "
            "groups says little about intervals.",
            digits={"longest (s)": 1},
        ),
    ]


def _lengths(study: Study) -> list[Block]:
    low, high = study.interval("L", LAWS)
    ours = averaged(study.parameter("L", LAWS))
    table = _both(ours, printed_lengths())
    ends = pd.concat({"95 % low": low, "95 % high": high}).swaplevel()
    full = pd.concat([table, ends]).sort_index(level=0, sort_remaining=False)
    bound = [n for n in study.recordings() if cell(ours, "lin", n) <= 2.0 + 1e-6]
    note = f" Lin ends at the lower bound of 2 m in {', '.join(bound)}." if bound else ""
    return [
        Heading("Car lengths"),
        TableBlock(
            "table_1",
            full,
            f"Identified car lengths L (m), with 95 % bootstrap intervals.{note}",
        ),
    ]


def _costs(study: Study) -> list[Block]:
    ours, theirs = study.costs(), printed_costs()
    lower = [
        (model, name)
        for model in ORDER
        for name in study.recordings()
        if cell(theirs, model, name) < cell(ours, model, name) - 0.005
    ]
    found: list[Block] = [
        Heading("Costs"),
        TableBlock(
            "table_2",
            ours,
            "Cost J (m² s) of the calibrated models, all sequences; least of a column in bold.",
            bold=least(ours),
        ),
        TableBlock(
            "table_2_printed",
            _both(ours, theirs),
            "The same beside the printed costs; a negative difference means lower here.",
        ),
    ]
    found.append(Text(_lower(study, ours, theirs, lower)))
    box = study.costs(suffix="-box")
    found.append(
        TableBlock(
            "table_2_box",
            pd.concat({"box": box, "free": ours.loc[list(NETWORKS)]}).swaplevel().sort_index(),
            f"What the box [-{study.options.box:g}, {study.options.box:g}] on all weights costs "
            "(m² s). The printed costs below those of the box cannot have been reached inside it.",
        )
    )
    return found


def _lower(
    study: Study, ours: pd.DataFrame, theirs: pd.DataFrame, lower: list[tuple[str, str]]
) -> str:
    said = "Where a printed cost of a network was lower, the search was made again, wider: "
    again = [
        f"{m}, {n}: {one['before']:.2f} became {one['cost']:.2f}"
        for m in NETWORKS
        for n in study.recordings()
        if "before" in (one := study.one("fit", n, m))
    ]
    said = f"{said}{'; '.join(again)}.\n\n" if again else ""
    if not lower:
        return said + "No printed cost is lower than the one found here."
    lines = []
    for model, name in lower:
        line = (
            f"- {model}, {name}: printed {cell(theirs, model, name):.2f}, here "
            f"{cell(ours, model, name):.2f}"
        )
        if model in LAWS:
            scan = study.one("scan", name, model)
            printed_length = cell(printed_lengths(), model, name)
            nearest = int(np.abs(np.array(scan["lengths"]) - printed_length).argmin())
            line += (
                f". A grid over all v0 and L finds no less than {scan['cost']:.2f}, and with the "
                f"printed L no less than {scan['by_length'][nearest]:.2f}: with the cost and the "
                "data as they are described, the printed value is not reached by any parameters"
            )
        else:
            one = study.one("fit", name, model)
            line += (
                f" after {one['restarts']} starts; the best tenth of them ended below "
                f"{one['starts'][1]:.2f}"
            )
        lines.append(line + ".")
    return said + "Printed costs lower than ours:\n\n" + "\n".join(lines)


def _speeds(study: Study) -> list[Block]:
    speeds = study.parameter("v0", ORDER) * KMH
    low, high = (end * KMH for end in study.interval("v0", ORDER))
    table = averaged(speeds)
    table.index.name = "model"
    means = ", ".join(f"{m} {cell(table, m, AVERAGE):.0f}" for m in ORDER)
    fastest = table[AVERAGE].idxmax()
    return [
        Heading("Leaders' speeds"),
        FigureBlock(
            "leader_speeds",
            leader_speeds(speeds, low, high),
            f"Identified speeds of the leading vehicle; lines are means ({means} km/h), bars "
            f"95 % intervals. The greatest mean is {fastest}'s. The paper reports means close to "
            "80 km/h, Lin's slightly larger; the limit there is 100 km/h.",
            "Leaders' speeds in km/h by recording and model, with mean lines.",
        ),
        TableBlock("leader_speeds", table, "The same as numbers (km/h).", digits=1),
    ]


def _laws(study: Study) -> list[Block]:
    names = study.recordings()
    gaps = {n: measured_gaps(study.sequences(n)) for n in names}
    free = _speeds_by_gap(study, "")
    bands = {
        n: {m: np.array(study.one("fit", n, m)["bootstrap"]["speeds"]) for m in ORDER}
        for n in names
    }
    long = pd.concat(
        {n: table.set_axis(list(GAPS)) for n, table in free.items()}, names=["recording", "gap"]
    )
    return [
        Heading("Interaction forces"),
        FigureBlock(
            "laws_box",
            law_panels(GAPS, _speeds_by_gap(study, "-box"), {}, gaps),
            f"Speed that each model gives a follower, by gap, 2 to 50 m; weights within "
            f"[-{study.options.box:g}, {study.options.box:g}]. As in the paper's figure the "
            "networks are smooth, and Lin and Log fall steeply at short gaps.",
            "Ten panels of speed against gap, five smooth curves each.",
        ),
        FigureBlock(
            "laws",
            law_panels(GAPS, free, bands, gaps),
            "The same with free weights, at the least costs found, with pointwise 95 % bands of "
            "local refits to resampled sequences. The networks bend sharply where single "
            "sequences, mostly faulty ones, ask for it: these costs are lower than the printed "
            "ones, and these laws are worse on unseen sequences "
            "([held-out costs](#table-heldout)).",
            "Ten panels of speed against gap, five curves each, the networks' with sharp bends.",
        ),
        TableBlock(
            "laws",
            long[long.index.get_level_values("gap") == 20.0].droplevel("gap"),
            "The speeds (m/s) at a gap of 20 m, weights free; the CSV holds all gaps.",
            full=long,
        ),
    ]


def _replay(study: Study) -> list[Block]:
    names = study.recordings("drop")
    number, every = 0, []
    for name in names:
        sequences = study.sequences(name, "drop")
        fits = {model: study.one("fit", name, model, "drop") for model in SHOWN}
        systems = {model: system_of(model, one["parameters"]) for model, one in fits.items()}
        every += scenes(spread(sequences, FEW), systems, study.options.dt)
        number += len(sequences)
    what = (
        f"Some sequences without a fault of every recording, beside {' and '.join(SHOWN)} as "
        "calibrated to them."
    )
    return [Heading("Replay"), player("replay", every, what, number)]


def _speeds_by_gap(study: Study, suffix: str) -> dict[str, pd.DataFrame]:
    """By recording, a column of speeds (m/s) per model; the suffix is of the networks."""
    return {
        n: pd.DataFrame(
            {m: study.one("fit", n, m + suffix * (m in NETWORKS))["speeds"] for m in ORDER}
        )
        for n in study.recordings()
    }
