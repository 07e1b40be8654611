"""A diagnosis as a file: the report, the extended model as options and as a checkpoint."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
import yaml

from nnode.calibrate.checkpoint import Checkpoint
from nnode.calibrate.evaluate import best_common_speed
from nnode.calibrate.optimizers import build_optimizer
from nnode.data.sequence import Sequence, collate
from nnode.diagnosis.outcome import DiagnosisOutcome
from nnode.diagnosis.result import Coefficient, Diagnosis, Laws, NamedEffect
from nnode.files import write_text
from nnode.model import FeedForward, System, build_model
from nnode.model.effects import IndividualEffect
from nnode.model.extend import effects_of

REPORT = "report.json"
MODEL = "model.yaml"
CHECKPOINT = Path("checkpoints", "best.pt")

#: Version of ``report.json``, raised when a key changes its name or meaning. 2: the base model's
#: parameters are named by term and name, ``lin.v0``.
SCHEMA = 4

#: The counters of a training that has not started.
UNTRAINED: dict[str, float] = {
    "epoch": 0,
    "batch": 0,
    "step": 0,
    "sum": 0.0,
    "gradient_norm": 0.0,
    "best": math.inf,
    "best_epoch": -1,
    "stale": 0,
    "seconds": 0.0,
}


def plain_report(diagnosis: Diagnosis) -> dict[str, Any]:
    """The content of ``report.json``: plain types, None for NaN and infinity."""
    content = _finite(diagnosis.plain())
    assert isinstance(content, dict)
    return {"schema": SCHEMA, **content}


def _finite(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {str(key): _finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(item) for item in value]
    if hasattr(value, "item"):  # numpy's numbers and arrays, torch's tensors
        return _finite(value.tolist())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def write_report(report: dict[str, Any], path: Path) -> Path:
    """Write a report as strict JSON."""
    return write_text(path, json.dumps(report, indent=2, ensure_ascii=False, allow_nan=False))


def amount(value: float | None, digits: int = 3) -> str:
    """A number as text: few digits, a minus sign, a dash for missing values."""
    if value is None or math.isnan(value):
        return "–"
    short = float(f"{value:.{digits}g}")
    return f"{short:g}".replace("-", "−")


def estimate(coefficient: Coefficient) -> tuple[str, str, str]:
    """A coefficient and the ends of its interval, with the significant digits."""
    c = coefficient
    width = max(c.high - c.value, c.value - c.low)
    if not (math.isfinite(width) and width > 0):
        return amount(c.value, 4), amount(c.low, 4), amount(c.high, 4)
    digits = min(max(1 - math.floor(math.log10(width)), 0), 9)
    value, low, high = (f"{x:.{digits}f}".replace("-", "−") for x in (c.value, c.low, c.high))
    return value, low, high


def in_unit(unit: str) -> str:
    """A unit after a number; empty for dimensionless numbers."""
    return "" if unit in ("", "1") else f" {unit}"


def interval(effect: NamedEffect) -> str:
    """An effect's coefficients with their intervals, in one line."""
    parts = []
    for name, c in effect.coefficients.items():
        value, low, high = estimate(c)
        parts.append(f"{name} = {value} [{low}, {high}]{in_unit(c.unit)}")
    return ", ".join(parts)


def ranked(laws: Laws) -> str:
    """The best laws in one line, with their excess costs."""
    return ", ".join(
        law.name + (f" (+{100 * law.behind:.3g} %)" if law.behind > 0 else "")
        for law in laws.ranking[:5]
    )


def sentence(diagnosis: Diagnosis) -> str:
    """The verdict in one sentence, one for a better-fitting law, and one for the faults of the
    measurement."""
    return " ".join([verdict(diagnosis), *remarks(diagnosis)])


def remarks(diagnosis: Diagnosis) -> list[str]:
    """Remarks on the verdict: a better-fitting law, faults of the measurement."""
    sentences, laws = [], diagnosis.laws_again or diagnosis.laws
    if laws is not None and laws.nearest not in ("", diagnosis.model):
        added = f", each with {_listed(laws.effects)}," if laws.effects else ","
        sentences.append(f"Of the compared laws{added} {laws.nearest} fits best.")
    faults = diagnosis.data_faults
    if faults:
        where = len({fault.sequence for fault in faults})
        sentences.append(
            f"{_count(where, 'sequence')} with {_count(len(faults), 'fault')} of the measurement "
            "were excluded."
        )
    return sentences


def verdict(d: Diagnosis) -> str:
    """The verdict in one sentence."""
    names = _listed([effect.name for effect in d.effects])
    gain = (
        "the extended model reduces the mean square error on the confirmation sequences from "
        f"{amount(d.gap.before)} to {amount(d.gap.after)} m², which removes {closed(d)} of the "
        f"error above the noise floor ({amount(d.gap.noise_floor)} m²)"
    )
    unconfirmed = ""
    hypotheses = _listed([effect.name for effect in d.hypotheses])
    if d.hypotheses:
        remain = "remains a hypothesis" if len(d.hypotheses) == 1 else "remain hypotheses"
        unconfirmed = f" {hypotheses} {remain}: {hypotheses_reason(d)}."
    match d.verdict:
        case "named":
            return f"The model {d.model} lacks {names}: {gain}.{unconfirmed}"
        case "indistinguishable":
            alternatives = {a.name for effect in d.effects for a in effect.alternatives}
            rivals = _listed(sorted(alternatives - {e.name for e in d.effects}), "or")
            return (
                f"The model {d.model} lacks an effect, but the data cannot distinguish {names} "
                f"from {rivals}: {gain}."
            )
        case "not_testable":
            c = d.clusters
            if c.exploration >= c.least_exploration:
                return (
                    "These data cannot test the model: no effect of the catalogue, with its "
                    "smallest relevant size, would be named with a probability of 80 %. No "
                    f"effect is named.{unconfirmed}"
                )
            return (
                f"The data are too few for a test: they contain "
                f"{_count(c.exploration, 'exploration cluster')} and "
                f"{_count(c.confirmation, 'confirmation cluster')}, and about {c.enough} clusters "
                f"are needed (a cluster is formed by {c.why}). No effect is named."
            )
        case "unknown" if d.law_at_bounds:
            effects = f", with {hypotheses} added" if d.hypotheses else ""
            return (
                f"The model {d.model} is not the law of these data: {_at_bounds(d)}{effects}. No "
                "effect of the catalogue explains the deviation."
            )
        case "unknown":
            variables = (
                _listed(d.unknown.variables) if d.unknown else "variables that were not tested"
            )
            beyond = f", beyond {names}," if d.effects else ""
            return (
                f"The model {d.model} deviates from the data{beyond} in a way that no effect of "
                f"the catalogue explains; the deviation depends on {variables}."
            )
        case "none":
            return (
                f"No missing effect was found: none of the catalogue improves the model {d.model} "
                f"significantly, and no structure remains in the residuals.{unconfirmed}"
            )


def hypotheses_reason(d: Diagnosis) -> str:
    """Why selected effects are hypotheses."""
    if d.law_at_bounds:
        return _at_bounds(d)
    return d.confirmation.reason or "a better-fitting law does without"


def _at_bounds(d: Diagnosis) -> str:
    ends = "ends at a bound" if len(d.law_at_bounds) == 1 else "end at bounds"
    return f"{_listed(d.law_at_bounds)} {ends} of the admissible values"


def _count(number: int, what: str) -> str:
    return f"{number} {what}{'' if number == 1 else 's'}"


def closed(diagnosis: Diagnosis) -> str:
    """The closed share of the gap, as a percentage."""
    share = diagnosis.gap.closed
    return "–" if math.isnan(share) else f"{100 * share:.0f} %".replace("-", "−")


def _listed(names: list[str], last: str = "and") -> str:
    if len(names) < 2:
        return names[0] if names else "nothing"
    return f"{', '.join(names[:-1])} {last} {names[-1]}"


def extended_options(options: Mapping[str, Any], system: System) -> dict[str, Any]:
    """The options of a model that give ``system``: effects, and parameters as start values.

    Weights of networks are not options; only a checkpoint contains them.

    Args:
        options: what the model was built from before it was calibrated and extended.
    """
    law_options = {
        name: float(getattr(term, name).detach())
        for term in system.terms
        if term not in effects_of(system)
        for name in getattr(term, "units", {})
        if name in options
    }
    effects = [{"name": effect.name, **effect.options()} for effect in effects_of(system)]
    names = [str(effect["name"]) for effect in effects]
    name = "_".join([str(options["name"]).split("_with_")[0], "with", *names])
    if not effects:
        name = f"{options['name']}_calibrated"
    options_kept = {key: value for key, value in options.items() if key != "effects"}
    return {**options_kept, "name": name, **law_options, "effects": effects}


def individual(system: System) -> list[str]:
    """The effects of a model with agent-specific parameters."""
    return [effect.name for effect in effects_of(system) if isinstance(effect, IndividualEffect)]


def has_network(system: System) -> bool:
    """Whether a model contains a network."""
    return any(isinstance(module, FeedForward) for module in system.modules())


def model_yaml(options: Mapping[str, Any], networks: bool) -> str:
    """A model's options as a file for ``conf/model``."""
    # the name appears in a comment, which a line break would end
    name = " ".join(str(options["name"]).split())
    lines = [
        f"# Made by nnode discover. Copy it to conf/model/{name}.yaml, "
        f"then: nnode train --config-dir conf model={name}",
    ]
    if networks:
        lines.append(f"# The weights of the network are in {CHECKPOINT} only: these would be new.")
    content = {"defaults": [f"{options['term']}_schema", "_self_"], **options}
    body = yaml.safe_dump(content, sort_keys=False, allow_unicode=True, default_flow_style=None)
    return "\n".join(lines) + "\n" + body


def rebuilt(options: Mapping[str, Any], system: System) -> System:
    """The model of ``options`` with the parameters of ``system``."""
    model = build_model(options, 0, torch.float64)
    target = {effect.name: effect for effect in effects_of(model)}
    for effect in effects_of(system):
        target[effect.name].load_state_dict(effect.state_dict())
    model_terms, system_terms = (
        [term for term in s.terms if term not in effects_of(s)] for s in (model, system)
    )
    for term, source in zip(model_terms, system_terms, strict=True):
        term.load_state_dict(source.state_dict())
    return model


def checkpoint_of(
    outcome: DiagnosisOutcome,
    sequences: list[Sequence],
    config: dict[str, Any],
    manifest: dict[str, Any],
    optimizer: Any,
) -> Checkpoint:
    """The extended model as a checkpoint: the exploration sequences are its training set, the
    confirmation sequences its test set.

    Args:
        config: a training's composed configuration in plain types, ``model`` that of the
            extended model.
        manifest: where the data come from.
        optimizer: options of the optimiser that training would go on with.
    """
    model = rebuilt(config["model"], outcome.extended)
    speed = None
    if model.domain == "traffic":
        speed = best_common_speed([collate([sequences[i] for i in outcome.exploration])], model)
    used = {*outcome.exploration, *outcome.confirmation}
    dropped = [i for i in range(len(sequences)) if i not in used]
    parts = {"train": outcome.exploration, "heldout": outcome.confirmation, "dropped": dropped}
    return Checkpoint(
        config=config,
        manifest=manifest,
        model=model.state_dict(),
        optimizer=build_optimizer(model, optimizer, int(config["seed"])).state_dict(),
        progress=dict(UNTRAINED),
        split={part: [sequences[i].name for i in places] for part, places in parts.items()},
        free_speed=speed,
    )
