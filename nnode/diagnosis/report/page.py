"""A diagnosis as one page, and as events for TensorBoard."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from nnode.calibrate.logbook import Logbook
from nnode.diagnosis.inputs import Inputs
from nnode.diagnosis.options import DiscoverOptions
from nnode.diagnosis.outcome import DiagnosisOutcome
from nnode.diagnosis.report import tables
from nnode.diagnosis.report.captions import Figures, figures, unit_of
from nnode.diagnosis.report.files import (
    CHECKPOINT,
    amount,
    has_network,
    hypotheses_reason,
    individual,
    interval,
    remarks,
    sentence,
    verdict,
)
from nnode.diagnosis.result import Diagnosis
from nnode.machine import how_made
from nnode.pages.page import Block, Heading, Provenance, Text, write_page
from nnode.pages.tables import markdown

TENSORBOARD = "tensorboard"
#: Sections that are folded.
_FOLDED = ("Comparison of base laws", "Independent clusters")

_PACKAGES = ("torch", "numpy", "scipy", "matplotlib")

_NETWORK = (
    "**The model is a network.** A network can represent any function of its inputs: the gap in "
    "traffic, the relative position and velocity in a crowd. Effects that depend on these inputs "
    "alone can be neither found nor excluded. Diagnose a physical law, such as `model=lin` or "
    "`model=sf`, to test them."
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
    d, c = outcome.diagnosis, outcome.diagnosis.clusters
    sections: dict[str, list[Block]] = {
        "Where the model deviates from the data": [*drawn["map"]],
        "Errors on confirmation sequences": _gap(d, drawn),
        "Coefficients": _coefficients(d, drawn, outcome),
        "Differences between agents": _agents(d),
        "How it was decided": _decided(d),
        "A typical confirmation sequence": [*drawn["paths"]],
        "Deviations by variable": [
            tables.places_table(d, unit_of(outcome.base))
            if d.places
            else Text("No curve over a variable is significant."),
            *drawn["places"],
        ],
        "Unexplained structure": _unexplained(d, drawn),
        "Effects that were not found": _absent(d),
        "Faults of the measurement": _data(d, drawn),
        "Using the extended model": _usage(commands, folder, outcome),
        "Comparison of base laws": _laws(d),
        "Independent clusters": [
            Text(
                f"A cluster consists of {c.why}; {c.simultaneous}. Clusters are the unit of every "
                "interval, test and cross-validation. No two-sided p-value can be below "
                f"{amount(d.screen.floor, 2)} with {c.exploration} exploration clusters."
            ),
            tables.clusters_table(d),
        ],
    }
    blocks: list[Block] = [Text(" ".join(words))] if (words := remarks(d)) else []
    for title, section in sections.items():
        if section:
            blocks += [Heading(title, folded=title in _FOLDED), *section]
    return [*blocks, _provenance(d, inputs)]


def _gap(d: Diagnosis, drawn: Figures) -> list[Block]:
    """The errors on the confirmation sequences, with the definition for the whole page."""
    n_confirmation, n_exploration = (
        len(d.split.get("confirmation", [])),
        len(d.split.get("exploration", [])),
    )
    return [
        *drawn["gap"],
        tables.gap_table(d),
        Text(
            f"{n_confirmation} of {n_confirmation + n_exploration} sequences are confirmation "
            f"sequences. Neither calibration nor search used them. {d.gap.definition}".strip()
        ),
    ]


def _coefficients(d: Diagnosis, drawn: Figures, outcome: DiagnosisOutcome) -> list[Block]:
    blocks: list[Block] = []
    if has_network(outcome.base):
        blocks.append(Text(_NETWORK))
    if d.effects:
        blocks += [tables.coefficients_table(d.effects), *drawn["effects"]]
    else:
        blocks.append(Text("No effect of the catalogue was added to the model."))
    if d.base:
        blocks.append(tables.base_table(d))
    if d.hypotheses:
        blocks += [
            Heading("Hypotheses that were not confirmed", 3),
            Text(f"Reason: {hypotheses_reason(d)}."),
            tables.coefficients_table(d.hypotheses, "hypotheses"),
        ]
    return blocks


def _agents(d: Diagnosis) -> list[Block]:
    """The differences between agents, in addition to population effects."""
    blocks: list[Block] = []
    if d.drivers:
        blocks.append(tables.drivers_table(d))
    if d.agents:
        blocks.append(tables.agents_table(d))
        if any(estimate.later for estimate in d.agents):
            blocks.append(tables.later_table(d))
    return blocks


def _decided(d: Diagnosis) -> list[Block]:
    """The tests behind the verdict."""
    blocks: list[Block] = []
    if d.notes:
        blocks.append(Text("\n".join(f"- {markdown(note)}" for note in d.notes)))
    if d.effects:
        blocks.append(tables.effects_table(d))
    if any(effect.alternatives for effect in d.effects):
        blocks.append(tables.alternatives_table(d))
    if d.clusters.exploration < d.clusters.least_exploration and d.screen.strongest:
        blocks += [
            Heading("Hypotheses", 3),
            Text(
                "These effects describe the exploration sequences best. The number of independent "
                "clusters is too small to distinguish them from chance."
            ),
            tables.screen_table(d),
        ]
    if d.confirmation_errors:
        blocks.append(tables.confirmation_table(d))
    return blocks


def _unexplained(d: Diagnosis, drawn: Figures) -> list[Block]:
    """Structure that no effect of the catalogue explains."""
    if d.unknown is None:
        return [Text("No curve is significant in the remaining residuals.")]
    facts = {
        "Variables": ", ".join(d.unknown.variables) or "none that was tested",
        "Share of the remaining squared errors that a nonparametric fit removes": (
            f"{100 * d.unknown.gain:.0f} %"
        ),
        "Similar formula (a hint, not a result)": f"`{d.unknown.hint}`" if d.unknown.hint else "–",
    }
    return [
        Text("\n".join(f"- {name}: {fact}" for name, fact in facts.items())),
        *drawn["unknown"],
        Text("An explanation can be tested as an effect of your own (`docs/discovery.md`)."),
    ]


def _absent(d: Diagnosis) -> list[Block]:
    """Effects that were not found, and those that these data cannot test."""
    blocks: list[Block] = []
    if any(absence.testable for absence in d.absences):
        blocks.append(tables.absent_table(d))
    if d.not_testable or any(not absence.testable for absence in d.absences):
        blocks.append(tables.not_testable_table(d))
    return blocks or [Text("All effects of the catalogue were found.")]


def _data(d: Diagnosis, drawn: Figures) -> list[Block]:
    if not d.data_faults:
        return [Text("No sequence has a fault.")]
    return [
        Text("Sequences with a fault were excluded. Check the recording at the given times."),
        tables.faults_table(d),
        *drawn["faults"],
    ]


def _laws(d: Diagnosis) -> list[Block]:
    """The comparison of base laws."""
    if d.laws is None or not d.laws.ranking:
        return []
    compared = {"laws": d.laws} | ({"laws_again": d.laws_again} if d.laws_again else {})
    latest = d.laws_again or d.laws
    words = f"Best law: {latest.best}. Diagnosed law: {d.model}."
    if latest.nearest != d.model and any(law.name == d.model for law in latest.ranking):
        words += " The folder `nearest_law` contains the diagnosis of the best law."
    elif latest.best != d.model:
        words += " The comparison does not reject the diagnosed law."
    refused = [
        f"- not compared: {markdown(name)} ({markdown(reason)})"
        for name, reason in d.laws.refused.items()
    ]
    return [
        Text(words),
        *(tables.laws_table(laws, name, d.domain) for name, laws in compared.items()),
        *([Text("\n".join(refused))] if refused else []),
    ]


def _usage(commands: list[str], folder: Path, outcome: DiagnosisOutcome) -> list[Block]:
    words = [
        "The extended model can be evaluated, plotted and trained like any other model. Training "
        "starts from the estimates."
    ]
    if has_network(outcome.base):
        words.append(
            "The weights of the network are stored in the checkpoint only. Training from the "
            "configuration starts with new weights."
        )
    words += [
        f"{name} acts only on agents of the exploration sequences, and `nnode evaluate` gives "
        "errors without it on confirmation sequences."
        for name in individual(outcome.extended)
    ]
    code = "```sh\n" + "\n".join(commands) + "\n```"
    python = f'```python\nimport nnode\n\nmodel = nnode.load("{folder / CHECKPOINT}")\n```'
    return [Text("\n\n".join([" ".join(words), code, python]))]


def _provenance(d: Diagnosis, inputs: Inputs) -> Provenance:
    facts = how_made(_PACKAGES)
    files = inputs.manifest.get("files", {})
    if files:
        listed = [f"{f['name']} (SHA-256 {f['sha256'][:12]})" for f in files.values()]
        facts["Data"] = ", ".join(listed[:12]) + (" …" if len(listed) > 12 else "")
    facts["Sequences"] = (
        f"exploration: {_names(d.split.get('exploration', []))}; "
        f"confirmation: {_names(d.split.get('confirmation', []))}"
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
        row = {"gap/confirmation": cost, "gap/noise_floor": d.gap.noise_floor}
        row |= {f"parameters/{n}": v[key] for n, v in d.base.items() if key in v}
        for effect in d.effects if step else []:
            values = {n: c.value for n, c in effect.coefficients.items()}
            row |= {f"effects/{effect.name}/{n}": value for n, value in values.items()}
        book.scalars({name: value for name, value in row.items() if _number(value)}, step)
    book.add_text("verdict", sentence(d), 0)
    effects = "\n\n".join(f"{e.name}: {interval(e)}; {e.where}" for e in d.effects)
    book.add_text("effects", effects, 0)
    for path in pictures:
        book.picture(f"diagnosis/{path.stem}", path, 1)
    book.close()
    return folder


def _number(value: Any) -> bool:
    return isinstance(value, int | float) and bool(np.isfinite(value))
