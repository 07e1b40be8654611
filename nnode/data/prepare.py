"""From raw files to a store: locate, read, find faults, apply the policy, write, remember."""

from __future__ import annotations

import hashlib
import json
import logging
import os
import shutil
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, cast

import numpy as np
import pandas as pd
from omegaconf import OmegaConf

from nnode.data.cut import Reading
from nnode.data.download import sha256
from nnode.data.identity import identify
from nnode.data.options import DataOptions, Starts, with_present_names
from nnode.data.quality import (
    Fault,
    apply_policy,
    by_recording,
    described,
    drop_absent,
    find_faults,
    interpolated,
    interpolated_text,
    left_out_texts,
)
from nnode.data.readers.columns import Table, quoted
from nnode.data.readers.esimas import EsimasOptions, esimas_files, read_esimas
from nnode.data.readers.highd import HighDOptions, highd_files, read_highd
from nnode.data.readers.juelich import JuelichOptions, juelich_files, read_juelich
from nnode.data.readers.jupedsim import (
    GEOMETRY,
    PEOPLE,
    WalkwayOptions,
    read_walkway,
    walkway_files,
)
from nnode.data.readers.ngsim import NgsimOptions, read_ngsim
from nnode.data.readers.openacc import OpenAccOptions, openacc_files, read_openacc
from nnode.data.readers.pairs import PairOptions, pair_files, read_pairs
from nnode.data.readers.recordings import reading
from nnode.data.readers.sumo import SumoOptions, read_sumo, sumo_files
from nnode.data.readers.table import TABLE as TIDY
from nnode.data.readers.table import WALLS, TableOptions, read_table, table_files
from nnode.data.readers.vehicles import VehicleTableOptions, read_vehicles, vehicle_files
from nnode.data.sequence import Domain, Sequence, check_interval
from nnode.data.smooth import measured_noise, start_smoothed
from nnode.data.store import Store, write_store
from nnode.errors import ConfigError, DataError
from nnode.files import file_name
from nnode.progress import Stages
from nnode.version import VERSION

log = logging.getLogger(__name__)

#: Sub-folder of a prepared folder with one plot of the faults per recording.
PLOTS = "faults"

#: Options that say where data lie or how they are used, not what is prepared.
NOT_PREPARATION = frozenset({"source", "download", "prepared", "split", "loader"})

#: Least number of dimensions of a domain's positions, which is also the greatest.
DIMENSIONS = {"traffic": 1, "crowd": 2}

_Files = dict[str, Any]  # paths; of tables in memory nnode.data.readers.columns.Table


#: Draws the faulty ones of some sequences: sequences, faults by name, domain, path of the PNG.
Draw = Callable[[list[Sequence], dict[str, list[Fault]], Domain, Path], Any]


@dataclass(frozen=True)
class Format:
    """A raw format: which files it needs, and how they become sequences."""

    files: Callable[..., _Files]
    read: Callable[[_Files, Any], Reading]
    tables: bool = False  # whether ``files`` takes a table in memory as well

    def sequences(self, files: _Files, options: Any) -> Reading:
        """Read the files.

        Raises:
            NNodeError: what cannot be read, see :func:`nnode.data.readers.recordings.reading`.
        """
        if not 0 <= options.fill < float("inf"):
            raise ConfigError(
                f"data.fill={options.fill}: expected a number of seconds, or 0 to interpolate "
                "nothing"
            )
        with reading(", ".join(str(getattr(file, "path", file)) for file in files.values())):
            return self.read(files, options)


def _each(read: Callable[[Path, Any], Reading]) -> Callable[[_Files, Any], Reading]:
    """Read files that do not depend on each other."""

    def every(files: _Files, options: Any) -> Reading:
        sequences = Reading()
        for path in files.values():
            sequences.add(read(path, options))
        return sequences

    return every


#: The format that each kind of options stands for; a new format is one more entry.
FORMATS: dict[type[DataOptions], Format] = {
    EsimasOptions: Format(esimas_files, _each(read_esimas)),
    VehicleTableOptions: Format(vehicle_files, _each(read_vehicles), tables=True),
    NgsimOptions: Format(vehicle_files, _each(read_ngsim)),
    JuelichOptions: Format(juelich_files, _each(read_juelich)),
    TableOptions: Format(
        table_files,
        lambda files, options: read_table(files[TIDY], options, files.get(WALLS)),
        tables=True,
    ),
    WalkwayOptions: Format(
        walkway_files,
        lambda files, options: read_walkway(files[PEOPLE], options, files.get(GEOMETRY)),
        tables=True,
    ),
    PairOptions: Format(pair_files, read_pairs, tables=True),
    OpenAccOptions: Format(openacc_files, read_openacc),
    SumoOptions: Format(sumo_files, _each(read_sumo)),
    HighDOptions: Format(highd_files, read_highd),
}


def format_of(options: DataOptions) -> Format:
    """The format that options stand for.

    Raises:
        ConfigError: none.
    """
    if type(options) not in FORMATS:
        kinds = ", ".join(kind.__name__ for kind in FORMATS)
        raise ConfigError(f"no reader for {type(options).__name__}; expected one of {kinds}")
    return FORMATS[type(options)]


def prepare(options: DataOptions, folder: Path | str, *, draw: Draw | None = None) -> Store:
    """Read raw files, sort out faults, and write the sequences and a manifest.

    Args:
        options: one of the options classes of :data:`FORMATS`.
        folder: where the store is written; an earlier one is replaced only when all is read
            and judged.
        draw: draws the faulty sequences of each recording into ``folder/faults``, such as
            :func:`nnode.plots.quality.plot_faults`; None draws nothing.

    Returns:
        The store. Its manifest has the source files and their SHA-256, all options, the
        package's version, the sampling interval (s), how many sequences were read, kept and
        dropped (in all and by recording), every fault that was found, every sequence and agent
        that was dropped and why, every record of which there is no sequence, what was interpolated
        to equal times or cut, in which sequences how many samples were filled, and the noise of
        the measurement (see :class:`nnode.data.smooth.Noise`).

    Raises:
        ConfigError: options that contradict each other or the data.
        DataError: raw files that cannot be read, or nothing left after dropping.
        FaultError: faults, with ``faults=error``.
    """
    folder, layout = Path(folder), format_of(options)
    downloads = options.download or str(folder / "raw")
    with Stages("preparing", {"reading": 2.0, "looking for faults": 1.0}) as stages:
        stages.begin("reading")
        files = layout.files(replace(options, download=downloads))
        read = layout.sequences(files, options)
        stages.begin("looking for faults")
        judged = judge(options, files, read, stages)
    with _drawn(folder, judged, draw):
        store = write_store(folder, judged.kept, judged.manifest)
    log.info("%d of %d sequences kept in %s", len(judged.kept), len(read), folder)
    return store


@dataclass(frozen=True)
class Judged:
    """What became of the sequences that were read.

    Attributes:
        domain: of the data.
        every: all sequences, people who come and go left out.
        faults: of every sequence by its name.
        kept: those that stay, with agents named once in a recording.
        manifest: see :func:`prepare`.
    """

    domain: Domain
    every: list[Sequence]
    faults: dict[str, list[Fault]]
    kept: list[Sequence]
    manifest: dict[str, Any]


def judge(
    options: DataOptions, files: _Files, read: Reading, stages: Stages | None = None
) -> Judged:
    """Search for faults and remove what the options do not keep.

    Args:
        files: what was read.
        stages: are told how far it is.

    Raises:
        NNodeError: see :func:`prepare`.
    """
    domain = _domain(options, read)
    _plausible(options, read)
    noise = measured_noise(read)
    sequences, absent = drop_absent(read) if domain == "crowd" else (read, [])
    faults = {}
    for number, s in enumerate(sequences):
        faults[s.name] = find_faults(s, domain, 0.0 if options.published else noise.position)
        if stages is not None:
            stages.within(number / len(sequences))
    kept, dropped = apply_policy(options.faults, sequences, faults)
    dropped_faults = [faults[entry["sequence"]] for entry in dropped]
    for text in [*read.notes, *left_out_texts(len(read), dropped_faults, read.left_out)]:
        log.warning("%s", text)
    # faults are told with the source's own identifiers, and of faulty sequences they are looked
    # at as well: through them one of those agents may go on
    agents, notes = identify(sequences, domain, options.agents)
    unique = {s.name: replace(s, agents=names) for s, names in zip(sequences, agents, strict=True)}
    kept = [unique[s.name] for s in kept]
    if options.start_speeds is Starts.smoothed:
        kept = [start_smoothed(s) for s in kept]
    if filled := interpolated(kept):
        log.info("%s", interpolated_text(filled))
    if notes:
        others = f" (and {len(notes) - 1} more recordings)" if len(notes) > 1 else ""
        log.info("%s%s; data.agents decides by hand", notes[0], others)
    manifest = {
        "package": {"name": "nnode", "version": VERSION},
        "reader": type(options).__name__,
        "options": plain(options),
        "identifiers": notes,
        "domain": domain,
        "dt": _interval(kept),
        "files": {key: _of_file(source) for key, source in files.items()},
        "counts": {"read": len(read), "kept": len(kept), "dropped": len(dropped)},
        "recordings": by_recording(read, kept, faults),
        "dropped": dropped,
        "dropped_agents": absent,
        "left_out": read.left_out,
        "notes": read.notes,
        "filled": filled,
        "noise": noise.plain(),
        "faults": [described(fault, s) for s in sequences for fault in faults[s.name]],
    }
    return Judged(domain, sequences, faults, kept, manifest)


def _of_file(source: Path | Table) -> dict[str, str]:
    """Name and SHA-256 of what was read."""
    if isinstance(source, Table):
        try:
            rows = pd.util.hash_pandas_object(source.frame, index=False)
        except (TypeError, ValueError):  # lists, and other cells without a hash
            rows = pd.util.hash_pandas_object(source.frame.map(quoted), index=False)
        whole = hashlib.sha256(rows.to_numpy().tobytes()).hexdigest()
        return {"name": source.path.name, "sha256": whole}
    return {"name": source.name, "sha256": sha256(source)}


def open_data(options: DataOptions, folder: Path | str) -> Store:
    """The prepared data that options ask for.

    Args:
        options: with ``prepared`` set, that folder is opened as it is, and nothing else needs to
            be said; otherwise data are prepared.
        folder: where they are prepared, without plots.

    Raises:
        ConfigError: ``prepared`` holds data that were prepared with other options than those
            that are not left at their defaults; names them.
        DataError, FaultError: see :func:`prepare`; or ``prepared`` holds no sound store.
    """
    if options.prepared is None:
        return prepare(options, folder)
    store = Store(Path(options.prepared).expanduser())
    if (made := made_by(store)) is not type(options):
        raise ConfigError(
            f"data.prepared={options.prepared} holds data of {made.__name__}, the options are "
            f"{type(options).__name__}; give {made.__name__}(prepared=...)"
        )
    usual = plain(type(options)())
    asked = {key: value for key, value in plain(options).items() if value != usual[key]}
    refuse_others(store, asked)
    return store


def made_by(store: Store) -> type[DataOptions]:
    """The class of the options that a store was prepared with.

    Raises:
        ConfigError: a store of an earlier version, which did not note it.
    """
    name = store.manifest.get("reader")
    kind_of_options = next((kind for kind in FORMATS if kind.__name__ == name), None)
    if kind_of_options is None:
        raise ConfigError(
            f"{store.folder} does not state which of nnode's readers prepared it (found {name!r}); "
            "prepare the data again, or set data.prepared=null to prepare on the fly"
        )
    return kind_of_options


def refuse_others(store: Store, asked: Mapping[str, Any]) -> None:
    """Refuse options that a store was not prepared with.

    Args:
        store: prepared.
        asked: plain values by the option's name, dots within it reach into mappings.

    Raises:
        ConfigError: names the options, what the store has, and what to do.
    """
    made = OmegaConf.create(_told(store.manifest.get("options", {})))
    differing = []
    for key, value in _told(asked).items():
        has = OmegaConf.select(made, key)
        has = OmegaConf.to_container(has) if OmegaConf.is_config(has) else has
        if value != has:
            differing.append((key, has, value))
    if differing:
        what = "; ".join(f"data.{k}={has} then, {value} now" for k, has, value in differing)
        names = ", ".join(f"data.{key}" for key, _, _ in differing)
        raise ConfigError(
            f"{store.folder} was prepared with other options: {what}. Leave out {names} to take "
            "the folder as it is, or data.prepared to prepare the data anew"
        )


def plain(options: DataOptions) -> dict[str, Any]:
    """Options as a dict that JSON can hold, as the manifest remembers them."""
    container = OmegaConf.to_container(OmegaConf.structured(options), enum_to_str=True)
    return cast(dict[str, Any], json.loads(json.dumps(container)))


def _told(options: Mapping[str, Any]) -> dict[str, Any]:
    """The options that decide what is prepared; of a table's path only the name."""
    options = with_present_names(options)
    chosen = {k: v for k, v in options.items() if k.partition(".")[0] not in NOT_PREPARATION}
    for key in ("path", "walls", "geometry"):
        if isinstance(chosen.get(key), str):
            chosen[key] = Path(chosen[key]).name
    return {key: value for key, value in chosen.items() if value != "???"}


def _domain(options: DataOptions, sequences: list[Sequence]) -> Domain:
    if options.domain not in DIMENSIONS:
        raise ConfigError(f"data.domain={options.domain}: expected traffic or crowd")
    expected = DIMENSIONS[options.domain]
    for s in sequences:
        if s.x.shape[2] != expected:
            raise ConfigError(
                f"data.domain={options.domain} needs {expected}-dimensional positions, sequence "
                f"{s.name} has {s.x.shape[2]}"
            )
    return cast(Domain, options.domain)


def _plausible(options: DataOptions, sequences: list[Sequence]) -> None:
    """Refuse times that are no seconds, before their steps count as faults."""
    steps = [s.dt for s in sequences if np.isfinite(s.dt)]
    if steps:
        # readers of published formats know the unit of their times
        remedy = "" if hasattr(options, "time_unit") else "its times must be in seconds"
        check_interval(float(np.median(steps)), f"data={options.name}", remedy)


def _interval(sequences: list[Sequence]) -> float:
    """The sampling interval that all sequences share."""
    first = sequences[0]
    for s in sequences:
        if not np.isclose(s.dt, first.dt, rtol=1e-6):
            raise DataError(
                f"{first.name} is sampled every {first.dt:g} s, {s.name} every {s.dt:g} s; one "
                "data set has one sampling interval: prepare them as two, choosing "
                "data.recording"
            )
    return round(float(np.median([s.dt for s in sequences])), 9)


@contextmanager
def _drawn(folder: Path, judged: Judged, draw: Draw | None) -> Iterator[None]:
    """Draw beside the folder's present plots, and put them in place after the body succeeds."""
    sequences, faults = judged.every, judged.faults
    partial = folder / f".{PLOTS}.{os.getpid()}.partial"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for leftover in folder.glob(".*.partial"):  # what an interrupted preparation left
            shutil.rmtree(leftover) if leftover.is_dir() else leftover.unlink()
        partial.mkdir()
    except OSError as error:
        raise DataError(f"{folder} cannot be written: {error}; choose another folder") from error
    try:
        if draw is not None:
            for recording in dict.fromkeys(s.recording for s in sequences):
                of_recording = [s for s in sequences if s.recording == recording]
                if any(faults[s.name] for s in of_recording):
                    name = f"{file_name(recording)}.png"
                    draw(of_recording, faults, judged.domain, partial / name)
        yield
        shutil.rmtree(folder / PLOTS, ignore_errors=True)
        if any(partial.iterdir()):
            os.replace(partial, folder / PLOTS)
    finally:
        shutil.rmtree(partial, ignore_errors=True)
