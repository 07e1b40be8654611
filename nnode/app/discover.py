"""What a model lacks: the command ``discover``."""

from __future__ import annotations

import logging
import shlex
import signal
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from omegaconf import DictConfig, OmegaConf

from nnode.app.cli.prepared import with_prepared
from nnode.app.cli.saved import plain_config
from nnode.app.cli.typed import changes, group_defaults, plain_options, shell_override
from nnode.app.nearest_law import Job, candidates, diagnosed, unwatched
from nnode.app.python.inputs import (
    Table,
    data_of,
    model_options,
    refuse_reading,
    table_options,
)
from nnode.app.python.report import Report
from nnode.app.python.words import python_words
from nnode.app.training import brief
from nnode.calibrate.checkpoint import save_checkpoint
from nnode.calibrate.interrupt import BreakingGuard, Interrupted, InterruptGuard
from nnode.calibrate.optimizers import AdadeltaOptions
from nnode.calibrate.options import TorchdiffeqOptions, TrainerOptions
from nnode.data.options import DataOptions, Faults
from nnode.data.sequences import Sequences
from nnode.discover.eligibility import check_model
from nnode.discover.inputs import Inputs, inputs_of, read_inputs, with_faulty
from nnode.discover.options import DiscoverOptions, check_options
from nnode.discover.outcome import DiagnosisOutcome
from nnode.discover.report.files import (
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

#: Folder of the diagnosis of the law that comes nearest, where another one was asked for.
NEAREST = "nearest_law"


def discover(config: DictConfig, folder: Path) -> None:
    """Diagnose a model on data, write the report, and print what was found.

    Raises:
        ConfigError: options that do not go together.
        DataError: data on which nothing can be diagnosed.
        Interrupted: a signal asked to stop.
    """
    start = time.monotonic()
    with BreakingGuard() as guard:
        try:
            config = with_prepared(config)
            plain = plain_config(config)
            options = cast(DiscoverOptions, OmegaConf.to_object(config.discover))
            data = cast(DataOptions, OmegaConf.to_object(config.data))
            read = partial(read_inputs, data, folder / "data")
            job = _job(plain["model"], data, plain["data"], plain["groups"], options, read)
            done = diagnosed(job, Stages)
            with Stages("drawing", {"drawing": 5.0}) as stages:
                stages.begin("drawing")
                written = [_drawn(one, found, place) for one, found, place in _places(done, folder)]
        except KeyboardInterrupt:
            number = guard.requested or signal.SIGINT
            raise Interrupted(
                f"stopped by {signal.Signals(number).name}: the diagnosis was not finished and "
                f"nothing of it is written to {folder}; the same command starts it again",
                number,
            ) from None
    with InterruptGuard() as guard:
        paths = [write() for write in reversed(written)][::-1]
    _print(done[0][1], paths[0], time.monotonic() - start)
    if len(done) > 1:
        print(f"\nthe best law, {done[1][0].name}:")
        _print(done[1][1], paths[1], time.monotonic() - start)
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
            :func:`nnode.sequences`; or those sequences.
        domain: ``traffic`` or ``crowd``; None: as the columns show.
        model: a name as in ``conf/model``, or options of the model; ``term`` says which, what is
            left out has its default.
        walls: CSV with x1, y1, x2, y2, m.
        leader: of a traffic model.
        folder: receives what the command writes, and a data frame as a table; None writes and
            draws nothing.
        seed: of the diagnosis; wins over that of ``options``.
        options: further options of the diagnosis.
        reading: how the table is read, as :func:`nnode.sequences` takes it: ``columns={...}``,
            ``position_unit="ft"``, ``faults="error"``, ...

    Raises:
        NNodeError: see :func:`discover`.
    """
    with python_words():
        return _diagnosed_table(
            data,
            domain,
            model,
            walls,
            leader,
            None if folder is None else Path(folder),
            seed,
            options,
            reading,
        )


def _diagnosed_table(
    data: Table | Sequences,
    domain: str | None,
    model: str | Mapping[str, Any],
    walls: str | Path | None,
    leader: str,
    place: Path | None,
    seed: int,
    options: DiscoverOptions | None,
    reading: Mapping[str, Any],
) -> Report:
    own = model_options(model, leader)
    chosen = DiscoverOptions(**{**vars(options or DiscoverOptions()), "seed": seed})
    source: Any = data
    if isinstance(data, Sequences):
        refuse_reading(None, {"walls": walls, **reading})
        told = data_of(data)
    else:
        source, told = table_options(data, domain, walls, place, reading)
    groups = {"model": str(own["name"]), "data": str(told.name)}

    def read() -> Inputs:
        return inputs_of(Sequences.of(source, with_faulty(told)), told)

    job = _job(own, told, plain_options(told), groups, chosen, read)
    done = diagnosed(job, unwatched)
    if place is not None:
        for one, found, where in reversed(_places(done, place)):
            _drawn(one, found, where)()
    first, *others = [
        Report(diagnosis=found.diagnosis, model=found.extended, draw=partial(_figure, one, found))
        for one, found in done
    ]
    return replace(first, nearest=others[0]) if others else first


def _figure(job: Job, found: DiagnosisOutcome, which: str) -> Figure:
    """A figure of a diagnosis, drawn when it is asked for."""
    from nnode.discover.report.captions import figure  # loads Matplotlib, which takes a second

    return figure(which, job.inputs, found, job.options)


def _job(
    model: dict[str, Any],
    data: DataOptions,
    plain_data: dict[str, Any],
    groups: dict[str, str],
    options: DiscoverOptions,
    read: Callable[[], Inputs],
) -> Job:
    start = time.monotonic()
    load_own()
    system = build_model(model, options.seed)
    if data.domain in ("traffic", "crowd") and data.domain != system.domain:
        raise ConfigError(
            f"model={model['name']} is a {system.domain} model, data={data.name} are "
            f"{data.domain} data; choose both of one domain"
        )
    check_options(options, system.domain, system.order)  # type: ignore[arg-type]
    check_model(system)
    laws = candidates(model, system, options)
    inputs = read()
    if data.prepared is None:  # a folder is taken as it is
        # what the extended model is trained and tested on are the sequences without a fault
        plain_data = {**plain_data, "faults": Faults.drop.value}
    seconds = time.monotonic() - start
    return Job(model, plain_data, groups, system, inputs, options, laws, seconds)


def _places(
    done: list[tuple[Job, DiagnosisOutcome]], folder: Path
) -> list[tuple[Job, DiagnosisOutcome, Path]]:
    """Where each diagnosis is written."""
    return [
        (job, found, place)
        for (job, found), place in zip(done, (folder, folder / NEAREST), strict=False)
    ]


def training_config(job: Job, found: DiagnosisOutcome) -> dict[str, Any]:
    """The configuration of a training that would go on with the extended model."""
    return {
        "model": extended_options(job.model, found.extended),
        "data": job.data,
        "solver": plain_options(TorchdiffeqOptions()),
        "optimizer": plain_options(AdadeltaOptions()),
        "trainer": plain_options(TrainerOptions()),
        "seed": job.options.seed,
        "groups": {**job.groups, "solver": "torchdiffeq", "optimizer": "adadelta"},
    }


def _drawn(job: Job, found: DiagnosisOutcome, folder: Path) -> Callable[[], dict[str, Path]]:
    """Draw the figures, where they are asked for; returns what writes all results, the report
    last, and gives their paths."""
    config = training_config(job, found)
    pages = None
    if job.options.page:
        from nnode.discover.report.page import draw  # loads Matplotlib, which takes a second

        pages = draw(job.inputs, found, job.options, config, _commands(config, folder), folder)
    checkpoint = checkpoint_of(
        found, job.inputs.sequences, config, brief(job.inputs.manifest), AdadeltaOptions()
    )
    path, text = folder / CHECKPOINT, model_yaml(config["model"], has_network(found.base))
    report = plain_report(found.diagnosis)

    def write() -> dict[str, Path]:
        try:
            (folder / REPORT).unlink(missing_ok=True)  # of an earlier run: it is there when all is
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
    """What can be done with the extended model, as it can be typed."""
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


def _print(found: DiagnosisOutcome, paths: Mapping[str, Path], seconds: float) -> None:
    d = found.diagnosis
    print(f"verdict: {d.verdict}")
    for laws in (d.laws, d.laws_again):
        if laws is not None and laws.ranking:
            beside = f", with {', '.join(laws.effects)}" if laws.effects else ""
            print(f"laws{beside}, by held-out cost: {ranked(laws)}")
    for note in d.notes:
        print(note)
    print(sentence(d))
    for effect in d.effects or d.leads:
        print(f"  {effect.name}: {interval(effect)}")
        print(f"    {effect.formula}; {effect.where}")
        for other in effect.alternatives:
            number = f", or about {other.clusters} exploration clusters" if other.clusters else ""
            print(f"    not distinguishable from {other.name} without {other.separated_by}{number}")
    for what, path in paths.items():
        print(f"{what}: {path}")
    print(f"time: {seconds:.1f} s")
