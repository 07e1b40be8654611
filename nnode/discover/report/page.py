"""A diagnosis as one page, and as events for TensorBoard."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from nnode.calibrate.logbook import Logbook
from nnode.discover.inputs import Inputs
from nnode.discover.options import DiscoverOptions
from nnode.discover.outcome import DiagnosisOutcome
from nnode.discover.report import tables
from nnode.discover.report.captions import Figures, figures, unit_of
from nnode.discover.report.files import (
    CHECKPOINT,
    amount,
    closed,
    has_network,
    in_unit,
    individual,
    interval,
    remarks,
    sentence,
    verdict,
)
from nnode.discover.result import Diagnosis
from nnode.machine import how_made
from nnode.pages.page import Block, Heading, Provenance, Text, write_page
from nnode.pages.tables import markdown

TENSORBOARD = "tensorboard"

_PACKAGES = ("torch", "numpy", "scipy", "matplotlib")

_NETWORK = (
    "**The model is a network.** A network can learn any function of its own inputs: an effect "
    "that depends on nothing else (in traffic on the gap, in a crowd on relative place and "
    "velocity) is inside its weights already and can be neither found nor excluded here. "
    "Diagnose a physical law, such as `model=lin` or `model=sf`, to learn about those."
)


def draw(
    inputs: Inputs,
    outcome: DiagnosisOutcome,
    options: DiscoverOptions,
    config: dict[str, Any],
    commands: list[str],
    folder: Path,
) -> Callable[[], dict[str, Path]]:
    """Draw all figures.

    Args:
        config: of a training with the extended model, as its checkpoint has it.
        commands: that make use of the extended model.
        folder: of the run.

    Returns:
        What writes the page and the events into the folder and returns their paths.
    """
    drawn = figures(inputs, outcome, options)
    blocks = page_blocks(inputs, outcome, drawn, commands, folder)
    title = f"Diagnosis of {outcome.diagnosis.model} on {config['data']['name']}"

    def write() -> dict[str, Path]:
        subtitle = verdict(outcome.diagnosis)
        page, *others = write_page(blocks, folder, title=title, subtitle=subtitle, stem="report")
        pictures = [path for path in others if path.suffix == ".png"]
        events = write_events(outcome, pictures, config, folder / TENSORBOARD)
        return {"page": page, "tensorboard": events}

    return write


def page_blocks(
    inputs: Inputs, outcome: DiagnosisOutcome, drawn: Figures, commands: list[str], folder: Path
) -> list[Block]:
    """The page in the order of the diagnosis, the verdict first."""
    d = outcome.diagnosis
    unit = unit_of(outcome.base)
    return [
        *_first(d),
        *_map(drawn),
        *_gap(d, drawn),
        *_coefficients(d, drawn, outcome),
        *_agents(d),
        *_model(d),
        *_shown(d, drawn),
        *_places(d, drawn, unit),
        *_rest(d, drawn, unit),
        *_usage(d, commands, folder, outcome),
        *_decided(d, drawn),
        *_data(d, drawn),
        *_laws(d),
        *_clusters(d),
        _provenance(d, inputs),
    ]


def _first(d: Diagnosis) -> list[Block]:
    """Remarks on the verdict."""
    words = remarks(d)
    return [Text(" ".join(words))] if words else []


def _map(drawn: Figures) -> list[Block]:
    if not drawn.map:
        return []
    return [Heading("Where the model deviates from the data"), *drawn.map]


def _laws(d: Diagnosis) -> list[Block]:
    """The comparison of base laws."""
    if d.laws is None or not d.laws.ranking:
        return []
    compared = [d.laws] if d.laws_again is None else [d.laws, d.laws_again]
    latest = compared[-1]
    asked = next((law for law in latest.ranking if law.name == d.model), None)
    qualifier = f", with {', '.join(latest.effects)}," if latest.effects else ""
    if latest.best == d.model:
        words = f"Of the laws that were compared, {d.model}{qualifier} comes nearest."
    elif asked is None:
        words = f"{latest.best}{qualifier} comes nearest; {d.model} was not compared."
    else:
        words = (
            f"**{latest.best}{qualifier} comes nearer than {d.model}**, whose held-out cost is "
            f"{100 * asked.behind:.3g} % higher (p = {amount(asked.p_value, 2)}). What {d.model} "
            f"lacks may be no effect but the other law: `nearest_law/` holds its diagnosis."
        )
    words += (
        f" Costs are those of {latest.clusters} open clusters that calibrations left out in turn."
    )
    if d.laws.refused:
        words += (
            " Not compared: "
            + "; ".join(f"{markdown(k)}: {markdown(v)}" for k, v in d.laws.refused.items())
            + "."
        )
    names = ("laws", "laws_again")
    return [
        Heading("Which base law"),
        Text(words),
        *(tables.laws_table(*law, d.domain) for law in zip(compared, names, strict=False)),
    ]


def _gap(d: Diagnosis, drawn: Figures) -> list[Block]:
    """The errors on the confirmation sequences, with the definition for the whole page."""
    n_confirmation, n_exploration = len(d.split.get("sealed", [])), len(d.split.get("open", []))
    return [
        Heading("The error on sealed sequences"),
        Text(
            f"{n_confirmation} of {n_confirmation + n_exploration} sequences were sealed: they "
            "were held back, and neither calibration nor search used them. "
            f"{d.gap.definition} {_gap_words(d)}".strip()
        ),
        tables.gap_table(d),
    ]


def _gap_words(d: Diagnosis) -> str:
    if not d.effects:
        return "No effect was added, so both errors are those of the calibrated model."
    return f"The effects close {closed(d)} of the gap between the model and the noise."


def _coefficients(d: Diagnosis, drawn: Figures, outcome: DiagnosisOutcome) -> list[Block]:
    blocks: list[Block] = [Heading("What is missing")]
    if has_network(outcome.base):
        blocks.append(Text(_NETWORK))
    if d.effects:
        blocks += [tables.coefficients_table(d.effects), *drawn.effects]
    else:
        blocks.append(Text("No effect of the catalogue was added to the model."))
    if d.leads:
        blocks += [
            Heading("Found, not confirmed", 3),
            Text(f"A lead to follow, not a finding: {d.confirmation.reason}."),
            tables.coefficients_table(d.leads, "leads"),
        ]
    return blocks


def _decided(d: Diagnosis, drawn: Figures) -> list[Block]:
    """The tests behind the verdict."""
    blocks: list[Block] = []
    if d.notes:
        blocks.append(Text("\n".join(f"- {markdown(note)}" for note in d.notes)))
    if d.effects:
        blocks.append(tables.effects_table(d))
    if any(effect.alternatives for effect in d.effects):
        blocks.append(tables.alternatives_table(d))
    if d.verdict == "not_testable" and d.screen.leads:
        blocks += [
            Heading("What one would look at first", 3),
            Text(
                "A description of the open sequences, and no finding: with so few independent "
                "clusters chance cannot be told from anything."
            ),
            tables.screen_table(d),
        ]
    blocks += drawn.gap
    if d.sealed:
        blocks.append(tables.confirmation_table(d))
    return [Heading("How it was decided"), *blocks] if blocks else []


def _clusters(d: Diagnosis) -> list[Block]:
    c = d.clusters
    return [
        Heading("What is independent of what"),
        Text(
            f"One cluster are {c.why}; {c.simultaneous}. Every interval, test and fold goes by "
            f"cluster. With {c.open} open {'cluster' if c.open == 1 else 'clusters'} no two-sided "
            f"p-value can be below {amount(d.screen.floor, 2)}."
        ),
        tables.clusters_table(d),
    ]


def _agents(d: Diagnosis) -> list[Block]:
    """The differences between agents, in addition to population effects."""
    if d.drivers:
        return [Heading("Do drivers differ?"), tables.drivers_table(d)]
    if not d.agents:
        return []
    words = [
        f"- {estimate.name}: "
        + ("named." if estimate.named else f"not named: {estimate.reason}.")
        + f" What lasts longer than {amount(estimate.lasts, 2)} s cannot be told from a number of "
        "one's own."
        for estimate in d.agents
    ]
    blocks: list[Block] = [
        Heading("Do agents differ?"),
        Text("\n".join(words)),
        tables.agents_table(d),
    ]
    if any(estimate.later for estimate in d.agents):
        blocks.append(tables.later_table(d))
    return blocks


def _data(d: Diagnosis, drawn: Figures) -> list[Block]:
    blocks: list[Block] = [Heading("Faults of the measurement")]
    if not d.data_faults:
        return [*blocks, Text("None: every sequence was used.")]
    sequences = {fault.sequence for fault in d.data_faults}
    return [
        *blocks,
        Text(
            f"{len(d.data_faults)} faults in {len(sequences)} sequences, which the diagnosis did "
            "without: what no vehicle and no person can have done is no missing effect. Look at "
            "the recording there, and correct it or leave it out."
        ),
        tables.faults_table(d),
        *drawn.faults,
    ]


def _model(d: Diagnosis) -> list[Block]:
    if not d.base:
        return []
    return [Heading("The model's own parameters"), tables.base_table(d)]


def _places(d: Diagnosis, drawn: Figures, unit: str) -> list[Block]:
    blocks: list[Block] = [Heading("Deviations by variable")]
    if d.places:
        words = [
            f"- {p.variable} in [{amount(p.low)}, {amount(p.high)}]{in_unit(p.unit)}: "
            f"{amount(p.deviation)} ± {amount(p.error, 2)} {unit}, "
            f"{'–' if np.isnan(p.share) else f'{100 * p.share:.0f} %'} of the excess error"
            for p in d.places[:3]
        ]
        blocks += [Text("\n".join(words)), tables.places_table(d, unit)]
    else:
        blocks.append(Text("No single variable that was looked at stands out."))
    return [*blocks, *drawn.places]


def _rest(d: Diagnosis, drawn: Figures, unit: str) -> list[Block]:
    blocks: list[Block] = [Heading("What is left")]
    if d.unknown is None:
        blocks.append(Text("No structure that a flexible fit would find."))
    else:
        hint = f" A form that comes near, as a hint only: `{d.unknown.hint}`."
        blocks += [
            Text(
                "Something that is not in the catalogue. It depends on "
                f"{', '.join(d.unknown.variables) or 'no variable that was looked at'}; a "
                f"flexible fit of the first removes {100 * d.unknown.gain:.0f} % of the squared "
                f"errors of positions that are left.{hint if d.unknown.hint else ''} "
                "Next: look at where it acts, think of a cause, and write it as an effect of "
                "your own (docs/discovery.md)."
            ),
            *drawn.unknown,
        ]
    blocks.append(Heading("Effects that were not found", 3))
    absent = any(absence.testable for absence in d.absences)
    untested = bool(d.not_testable) or any(not absence.testable for absence in d.absences)
    if absent:
        blocks.append(tables.absent_table(d))
    if untested:
        blocks.append(tables.not_testable_table(d))
    if not absent and not untested:
        blocks.append(Text("None was left to look for."))
    return blocks


def _shown(d: Diagnosis, drawn: Figures) -> list[Block]:
    if not drawn.paths:
        return []
    return [Heading("A sealed sequence"), *drawn.paths]


def _usage(
    d: Diagnosis, commands: list[str], folder: Path, outcome: DiagnosisOutcome
) -> list[Block]:
    more = ""
    if has_network(outcome.base):
        more += (
            " The weights of the network are in the checkpoint alone; trained from the "
            "configuration it starts anew."
        )
    for name in individual(outcome.extended):
        more += (
            f" {name} knows the agents of the open sequences; for all others it does not act, so "
            "that the errors that the command `evaluate` gives on sealed sequences are those "
            "without it."
        )
    words = (
        "The extended model is a model like any other: errors beside baselines on the sealed "
        "sequences, force plots, and further training from its configuration, in which every "
        f"parameter starts at its estimate.{more}"
    )
    code = "```sh\n" + "\n".join(commands) + "\n```"
    python = f'```python\nimport nnode\n\nmodel = nnode.load("{folder / CHECKPOINT}")\n```'
    return [Heading("Using the extended model"), Text(f"{words}\n\n{code}\n\n{python}")]


def _provenance(d: Diagnosis, inputs: Inputs) -> Provenance:
    facts = how_made(_PACKAGES)
    files = inputs.manifest.get("files", {})
    if files:
        listed = [f"{f['name']} (SHA-256 {f['sha256'][:12]})" for f in files.values()]
        facts["Data"] = ", ".join(listed[:12]) + (" …" if len(listed) > 12 else "")
    facts["Sequences"] = (
        f"open: {_names(d.split.get('open', []))}; sealed: {_names(d.split.get('sealed', []))}"
    )
    facts["Time"] = ", ".join(f"{what} {seconds:.1f} s" for what, seconds in d.seconds.items())
    return Provenance(facts)


def _names(names: list[str]) -> str:
    return ", ".join(names[:40]) + (f" and {len(names) - 40} more" if len(names) > 40 else "")


def write_events(
    outcome: DiagnosisOutcome, pictures: list[Path], config: dict[str, Any], folder: Path
) -> Path:
    """Write TensorBoard's events: step 0 is the model as it was given, step 1 the extended one.

    Events of an earlier run in the folder are replaced.

    Args:
        pictures: the page's figures.
    """
    d = outcome.diagnosis
    shutil.rmtree(folder, ignore_errors=True)
    book = Logbook(folder, config)
    for step, (cost, key) in enumerate(((d.gap.before, "before"), (d.gap.after, "after"))):
        row = {"gap/sealed": cost, "gap/noise_floor": d.gap.noise_floor}
        row |= {f"parameters/{n}": v[key] for n, v in d.base.items() if key in v}
        book.scalars({name: value for name, value in row.items() if _number(value)}, step)
    for effect in d.effects:
        row = {f"effects/{effect.name}/{n}": c.value for n, c in effect.coefficients.items()}
        book.scalars({name: value for name, value in row.items() if _number(value)}, 1)
    book.text("verdict", sentence(d))
    book.text("effects", "\n\n".join(f"{e.name}: {interval(e)}; {e.where}" for e in d.effects))
    for path in pictures:
        book.picture(f"diagnosis/{path.stem}", path, 1)
    book.close()
    return folder


def _number(value: Any) -> bool:
    return isinstance(value, int | float) and bool(np.isfinite(value))
