"""Diagnosis of a model: the command ``discover``."""

from __future__ import annotations

import logging
import shlex
import signal
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from omegaconf import DictConfig

from nnode.app.cli.prepared import with_prepared
from nnode.app.cli.saved import options_of, plain_config
from nnode.app.cli.typed import changes, group_defaults, plain_options, shell_override
from nnode.app.compared_laws import compared_laws, law_options
from nnode.app.python.inputs import (
    Table,
    data_of,
    model_options,
    refuse_reading,
    table_options,
)
from nnode.app.python.report import Report
from nnode.app.training import brief, check_domain, set_threads, threads_given_back
from nnode.calibrate.checkpoint import save_checkpoint
from nnode.calibrate.interrupt import BreakingGuard, Interrupted, InterruptGuard
from nnode.calibrate.optimizers import AdadeltaOptions
from nnode.calibrate.options import TorchdiffeqOptions, TrainerOptions
from nnode.data.options import DataOptions, Faults
from nnode.data.sequences import Sequences
from nnode.diagnosis.diagnose import diagnose
from nnode.diagnosis.eligibility import check_model
from nnode.diagnosis.inputs import Inputs, inputs_of, read_inputs, with_faulty
from nnode.diagnosis.options import DiscoverOptions, check_options
from nnode.diagnosis.outcome import DiagnosisOutcome
from nnode.diagnosis.report.files import (
    CHECKPOINT,
    MODEL,
    REPORT,
    checkpoint_of,
    extended_options,
    has_network,
    interval,
    model_yaml,
    plain_report,
    ranked,
    sentence,
    write_report,
)
from nnode.errors import ConfigError
from nnode.files import write_text
from nnode.model import build_model
from nnode.model.effects.own import load_own
from nnode.progress import Stages

if TYPE_CHECKING:
    from matplotlib.figure import Figure

log = logging.getLogger(__name__)

#: Folder of the diagnosis of the nearest law, if it is not the requested one.
NEAREST = "nearest_law"
#: Data sources whose positions were smoothed before they were published.
SMOOTHED_SOURCES = {
    "astazero",
    "highd",
    "ngsim",
    "ngsim_pairs",
    "openacc",
    "pairs",
    "tgsim",
    "waymo_pairs",
}


@dataclass(frozen=True)
class Job:
    """What a diagnosis was made of.

    Attributes:
        model, data: options of the diagnosed law and of the data in plain types.
        groups: the configuration groups of model and data.
        inputs: the data.
        options: the checked options.
    """

    model: dict[str, Any]
    data: dict[str, Any]
    groups: dict[str, str]
    inputs: Inputs
    options: DiscoverOptions


def discover(config: DictConfig, folder: Path) -> None:
    """Diagnose a model on data, write the report, and print the result.

    Raises:
        ConfigError: incompatible options.
        DataError: the data are insufficient for a diagnosis.
        Interrupted: a signal stopped the diagnosis.
    """
    start = time.monotonic()
    left = (
        f": the diagnosis was not finished and nothing of it is written to {folder}; the same "
        "command starts it again"
    )
    with BreakingGuard(left):
        config = with_prepared(config)
        plain = plain_config(config)
        options: DiscoverOptions = options_of(config.discover)
        data: DataOptions = options_of(config.data)
        read = partial(read_inputs, data, folder / "data")
        diagnoses = _diagnoses(plain["model"], data, plain["data"], plain["groups"], options, read)
        with Stages("drawing", {"drawing": 5.0}) as stages:
            stages.begin("drawing")
            written = [_drawn(*result) for result in _places(diagnoses, folder)]
    with InterruptGuard() as guard:
        paths = [write() for write in reversed(written)][::-1]
    _print(diagnoses[0][1], paths[0], time.monotonic() - start)
    if len(diagnoses) > 1:
        print(f"\nthe best law, {diagnoses[1][1].diagnosis.model}:")
        _print(diagnoses[1][1], paths[1], time.monotonic() - start)
    if guard.requested:
        name = signal.Signals(guard.requested).name
        raise Interrupted(f"stopped by {name} when all was written", guard.requested)


def diagnose_table(
    data: Table | Sequences,
    domain: str | None = None,
    *,
    model: str | Mapping[str, Any] = "lin",
    walls: str | Path | None = None,
    leader: str = "measured",
    folder: str | Path | None = None,
    seed: int = 0,
    options: DiscoverOptions | None = None,
    **reading: Any,
) -> Report:
    """Diagnose a model on a table.

    Args:
        data: CSV or Parquet, or a data frame, whose columns and units are recognised, see
            :func:`nnode.sequences`; or the sequences that it returns.
        domain: ``traffic`` or ``crowd``; None recognises it from the columns.
        model: a name as in ``conf/model``, or options of the model with its ``term``; other
            options have defaults.
        walls: CSV with x1, y1, x2, y2, m.
        leader: ``constant`` or ``measured``, for a traffic model.
        folder: folder for the files of the command, and for a data frame as a table; None writes
            and draws nothing.
        seed: seed of the diagnosis; it replaces that of ``options``.
        options: further options of the diagnosis.
        reading: options for reading the table, as for :func:`nnode.sequences`: ``columns={...}``,
            ``position_unit="ft"``, ``faults="error"``, ...

    Raises:
        NNodeError: see :func:`discover`.
    """
    plain_model = model_options(model, leader)
    chosen = replace(options or DiscoverOptions(), seed=seed)
    place = None if folder is None else Path(folder)
    source: Any = data
    if not isinstance(data, Table):
        refuse_reading(None, {"walls": walls, **reading})
        source = Sequences.of(data)
        data_options = data_of(source)
    else:
        source, data_options = table_options(data, domain, walls, place, reading)
    groups = {"model": str(plain_model["name"]), "data": str(data_options.name)}

    def read() -> Inputs:
        return inputs_of(Sequences.of(source, with_faulty(data_options)), data_options)

    plain_data = plain_options(data_options)
    diagnoses = _diagnoses(plain_model, data_options, plain_data, groups, chosen, read)
    if place is not None:
        for result in reversed(_places(diagnoses, place)):
            _drawn(*result)()
    first, *others = [
        Report(
            diagnosis=outcome.diagnosis,
            model=outcome.extended,
            draw=partial(_figure, diagnosed_job, outcome),
        )
        for diagnosed_job, outcome in diagnoses
    ]
    return replace(first, nearest=others[0]) if others else first


def _figure(job: Job, outcome: DiagnosisOutcome, which: str) -> Figure:
    """A figure of a diagnosis, drawn on request."""
    from nnode.diagnosis.report.captions import figure  # loads Matplotlib, which takes a second

    return figure(which, job.inputs, outcome, job.options)


@threads_given_back()
def _diagnoses(
    model: dict[str, Any],
    data: DataOptions,
    plain_data: dict[str, Any],
    groups: dict[str, str],
    options: DiscoverOptions,
    read: Callable[[], Inputs],
) -> list[tuple[Job, DiagnosisOutcome]]:
    """Check the options, read the data, and diagnose the requested law and the best-fitting one."""
    start = time.monotonic()
    load_own()
    name, system = str(model["name"]), build_model(model, options.seed)
    check_domain(system, name, str(data.domain), str(data.name))
    check_options(options, system.domain, system.order)
    check_model(system)
    laws = compared_laws(model, system, options)
    inputs = read()
    if options.smoothed is None:
        smoothed = data.smooth is not None or str(data.name) in SMOOTHED_SOURCES
        options = replace(options, smoothed=smoothed)
    if data.prepared is None:  # options of a prepared folder are fixed
        # the extended model is trained and tested on the sequences without faults
        plain_data = {**plain_data, "faults": Faults.drop.value}
    seconds = time.monotonic() - start
    set_threads(None, system.domain)
    outcomes = diagnose(name, system, laws, inputs, options)
    first = outcomes[0].diagnosis
    first.seconds = {"reading": seconds, **first.seconds}
    diagnoses = []
    for outcome in outcomes:
        law = outcome.diagnosis.model
        job = Job(model, plain_data, groups, inputs, options)
        if law != name:
            job = replace(job, model=law_options(law, model), groups={**groups, "model": law})
        diagnoses.append((job, outcome))
    return diagnoses


def _places(
    diagnoses: list[tuple[Job, DiagnosisOutcome]], folder: Path
) -> list[tuple[Job, DiagnosisOutcome, Path]]:
    """The diagnoses with their folders."""
    return [
        (job, outcome, place)
        for (job, outcome), place in zip(diagnoses, (folder, folder / NEAREST), strict=False)
    ]


def training_config(job: Job, outcome: DiagnosisOutcome) -> dict[str, Any]:
    """The configuration of a training that would continue with the extended model."""
    return {
        "model": extended_options(job.model, outcome.extended),
        "data": job.data,
        "solver": plain_options(TorchdiffeqOptions()),
        "optimizer": plain_options(AdadeltaOptions()),
        "trainer": plain_options(TrainerOptions()),
        "seed": job.options.seed,
        "groups": {**job.groups, "solver": "torchdiffeq", "optimizer": "adadelta"},
    }


def _drawn(job: Job, outcome: DiagnosisOutcome, folder: Path) -> Callable[[], dict[str, Path]]:
    """Draw the requested figures, and return a function that writes all results.

    The function writes the report last and returns the paths.
    """
    config = training_config(job, outcome)
    pages = None
    if job.options.page:
        from nnode.diagnosis.report.page import draw  # loads Matplotlib, which takes a second

        pages = draw(job.inputs, outcome, job.options, config, _commands(config, folder), folder)
    checkpoint = checkpoint_of(
        outcome, job.inputs.sequences, config, brief(job.inputs.manifest), AdadeltaOptions()
    )
    path, text = folder / CHECKPOINT, model_yaml(config["model"], has_network(outcome.base))
    report = plain_report(outcome.diagnosis)

    def write() -> dict[str, Path]:
        try:
            # the report exists only if all other results do
            (folder / REPORT).unlink(missing_ok=True)
            save_checkpoint(checkpoint, path)
            model = write_text(folder / MODEL, text)
            drawn = {} if pages is None else pages()
            return {
                "report": write_report(report, folder / REPORT),
                **drawn,
                "extended model": model,
                "checkpoint": path,
            }
        except OSError as error:
            raise ConfigError(
                f"the report cannot be written to {folder} ({error}); choose another hydra.run.dir"
            ) from error

    return write


def _commands(config: Mapping[str, Any], folder: Path) -> list[str]:
    """Commands for the extended model, quoted for the shell."""
    checkpoint = shell_override("checkpoint", folder / CHECKPOINT)
    name, group = config["model"]["name"], config["groups"]["data"]
    place = shlex.quote(str(folder / MODEL))
    copy = shlex.quote(f"conf/model/{name}.yaml")
    model, data = shell_override("model", name), shell_override("data", group)
    options = changes("data", config["data"], group_defaults("data", group))
    return [
        f"nnode evaluate {checkpoint}",
        f"nnode plot_forces {checkpoint}",
        f"mkdir -p conf/model && cp {place} {copy}",
        " ".join(["nnode train --config-dir conf", model, data, *options]),
    ]


def _print(outcome: DiagnosisOutcome, paths: Mapping[str, Path], seconds: float) -> None:
    d = outcome.diagnosis
    print(f"verdict: {d.verdict}")
    for laws in (d.laws, d.laws_again):
        if laws is not None and laws.ranking:
            effects = f", with {', '.join(laws.effects)}" if laws.effects else ""
            criterion = "likelihood" if laws.likelihood else "held-out cost"
            print(f"laws{effects}, by {criterion}: {ranked(laws)}")
    for note in d.notes:
        print(note)
    print(sentence(d))
    for effect in d.effects or d.hypotheses:
        print(f"  {effect.name}: {interval(effect)}")
        print(f"    {effect.formula}; {effect.where}")
        for other in effect.alternatives:
            needed = other.distinguishing_data
            if other.clusters:
                needed += f", or about {other.clusters} exploration clusters"
            print(f"    not distinguishable from {other.name} without {needed}")
    for what, path in paths.items():
        print(f"{what}: {path}")
    print(f"time: {seconds:.1f} s")
