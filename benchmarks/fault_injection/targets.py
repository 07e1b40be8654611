"""What is fuzzed: each reader and each loader, and the malformed files that it is given.

``corpus`` contains the sound files.
"""

from __future__ import annotations

import copy
import gzip
import io
import json
import pickle
import shutil
import sqlite3
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from hypothesis.strategies import SearchStrategy
from omegaconf import MISSING
from scipy.io import savemat

from benchmarks.fault_injection.damage import (
    damaged_bytes,
    damaged_formula,
    damaged_text,
    evil_checkpoint,
    strange_checkpoint,
    strange_frame,
)
from nnode.app.check import check_file
from nnode.calibrate.checkpoint import Checkpoint, load_checkpoint, save_checkpoint
from nnode.calibrate.optimizers import AdadeltaOptions, build_optimizer
from nnode.data.identity import identify
from nnode.data.options import DataOptions
from nnode.data.prepare import FORMATS
from nnode.data.quality import drop_absent, find_faults
from nnode.data.readers.esimas import EsimasOptions
from nnode.data.readers.highd import RECORDING_META, TRACKS, TRACKS_META, HighDOptions
from nnode.data.readers.juelich import JuelichOptions
from nnode.data.readers.jupedsim import GEOMETRY, PEOPLE, WalkwayOptions
from nnode.data.readers.ngsim import NgsimOptions
from nnode.data.readers.openacc import OpenAccOptions
from nnode.data.readers.pairs import PairOptions
from nnode.data.readers.sumo import SumoOptions
from nnode.data.readers.table import TABLE as TIDY
from nnode.data.readers.table import WALLS, TableOptions
from nnode.data.readers.vehicles import VehicleTableOptions
from nnode.data.sequence import Domain, Sequence
from nnode.data.sequences import Sequences
from nnode.data.store import MANIFEST, TABLE, Store, write_store
from nnode.model import Traffic, build_model
from nnode.model.laws import law_from
from nnode.simulation.kernels import source
from studies.runner import KEPT, Task, run_tasks

#: Sound files.
CORPUS = Path(__file__).with_name("corpus")
#: Accelerations that can be read.
_FORMULAS = (
    "a*(1 - (v/v0)**4 - ((s0 + max(v*T + v*dv/(2*sqrt(a*b)), 0))/gap)**2)",
    "choose(dv, -b*tanh(dv/v0), a*exp(-gap/s0)) - clip(v/T, 0, b)",
    "(v0*log(max(gap, s0)/s0) - v)/T + softplus(v/v0)*min(a, b)*abs(v)/v0",
)
_QUANTITIES = {"v0": "30 m/s", "T": "1.2 s", "s0": "2 m", "a": "1.3 m/s²", "b": "1.7 m/s²"}
#: Name of what evil files try to write.
OUTSIDE = "outside"


@dataclass(frozen=True, eq=False)
class Target:
    """A reader and its malformed inputs.

    Attributes:
        name: of the target.
        file: name of the file that it reads.
        inputs: contents of malformed files.
        read: reads all of the file; takes its path.
    """

    name: str
    file: str
    inputs: SearchStrategy[bytes]
    read: Callable[[Path], Any]


def _parquet(frame: pd.DataFrame) -> bytes:
    made = io.BytesIO()
    frame.to_parquet(made, index=False)
    return made.getvalue()


def _mat(*, packed: bool) -> bytes:
    cells = np.empty((1, 2), dtype=object)
    x = 20.0 * np.arange(3)[:, None] + 3.0 * np.arange(4)
    cells[0, 0] = cells[0, 1] = {"Xarr": x, "Tarr": 0.2 * np.arange(4)[None]}
    made = io.BytesIO()
    savemat(made, {"sequences": cells}, do_compression=packed)
    return made.getvalue()


def _walkway(path: Path) -> bytes:
    with closing(sqlite3.connect(path)) as base:
        base.executescript((CORPUS / "walkway.sql").read_text())
    return path.read_bytes()


def _checkpoint(path: Path) -> bytes:
    options = {
        "term": "lin",
        "name": "lin",
        "v0": 30.0,
        "L": 5.0,
        "L_min": 2.0,
        "leader": "constant",
    }
    model = build_model(options)
    groups = {"model": "lin", "data": "esimas", "solver": "torchdiffeq", "optimizer": "adadelta"}
    checkpoint = Checkpoint(
        config={"model": options, "seed": 0, "trainer": {"dtype": "float64"}, "groups": groups},
        manifest={"dt": 0.2, "files": {"demo": {"sha256": "0" * 64}}},
        model=dict(model.state_dict()),
        optimizer=build_optimizer(model, AdadeltaOptions(), 0).state_dict(),
        progress={"epoch": 1, "batch": 0, "step": 3, "best": 1.5},
        history=[{"epoch": 0.0, "cost/train": 2.0}],
        split={"train": ["demo/000"], "heldout": []},
        free_speed=25.0,
    )
    save_checkpoint(checkpoint, path)
    return path.read_bytes()


def _store(folder: Path) -> tuple[bytes, bytes]:
    items = [
        Sequence(
            name=f"r/{i}",
            recording="r",
            time=0.1 * np.arange(4),
            agents=("a", "b"),
            x=np.random.default_rng(i).normal(size=(4, 2, 2)),
            walls=np.array([[0.0, 0, 5, 0]]),
        )
        for i in range(2)
    ]
    write_store(folder, items, {"domain": "crowd", "dt": 0.1})
    return (folder / MANIFEST).read_bytes(), (folder / TABLE).read_bytes()


def read_all(options: DataOptions, files: dict[str, Any]) -> None:
    """Read files and look for faults, without the last resort for foreign errors."""
    sequences: list[Sequence] = FORMATS[type(options)].read(files, options)
    domain: Domain = "crowd" if options.domain == "crowd" else "traffic"
    if domain == "crowd":
        sequences, _ = drop_absent(sequences)
    for sequence in sequences:
        find_faults(sequence, domain)
    identify(sequences, domain, options.agents)


def _reads(*every: DataOptions, key: str | None = None, **others: Path) -> Callable[[Path], None]:
    """A reader of a file, once with each of the options.

    Args:
        key: of the file among those that are read; by default its stem.
        others: further files, which are sound.
    """

    def read(path: Path) -> None:
        for options in every:
            given = copy.copy(options)
            if vars(given).get("path", MISSING) == MISSING:
                vars(given)["path"] = str(path)
            read_all(given, {**others, key or path.stem: path})

    return read


def _read_highd(path: Path) -> None:
    files = {end: path.with_name(f"01{end}") for end in (TRACKS, TRACKS_META, RECORDING_META)}
    read_all(HighDOptions(path=str(path), min_samples=2, dt=0.2), files)


def _read_frame(path: Path) -> None:
    """As a notebook gives it; what pickle makes of it is the campaign's own."""
    Sequences.of(pickle.loads(path.read_bytes()))


def _read_checkpoint(path: Path) -> None:
    load_checkpoint(path).build()


def _read_store(path: Path) -> None:
    for item in Store(path.parent):
        item.velocity()


def constant(x: float) -> dict[str, Any]:
    """A task whose kept result is damaged."""
    return {"x": x}


def _read_kept(path: Path) -> None:
    task = Task("one", constant, {"x": 1.0})
    results = run_tasks([task], path.parent.parent, workers=1, fingerprint="f")
    if results != {"one": {"x": 1.0}}:
        assert json.loads(path.read_text())["result"] == results["one"]


def _read_formula(path: Path) -> None:
    """A law and its compiled form, up to the source text."""
    text = path.read_bytes().decode(errors="replace")
    model = Traffic([law_from("law", {"parameters": _QUANTITIES, "rate": {"v": text}})])
    compile(source(model), "law", "exec")


def targets(scratch: Path) -> list[Target]:
    """All targets.

    Args:
        scratch: receives what is damaged in its folder; evil files try to write beside it.
    """
    outside = scratch.with_name(OUTSIDE)
    sound = {path.name: path.read_bytes() for path in CORPUS.glob("*.*")}
    shutil.copytree(CORPUS / "highd", scratch / "highd")
    manifest, table = _store(scratch / "manifest")
    (scratch / "table").mkdir()
    (scratch / "table" / MANIFEST).write_bytes(manifest)
    run_tasks([Task("one", constant, {"x": 1.0})], scratch / "kept", workers=1, fingerprint="f")
    kept = (scratch / "kept" / KEPT / "one.json").read_bytes()
    checkpoint = _checkpoint(scratch / "seed.pt")
    tracks = f"highd/01{TRACKS}"
    tables = ["traffic.csv", "crowd.csv", "vehicles.csv", "pairs.csv"]
    frames = [pd.read_csv(CORPUS / name, keep_default_na=False) for name in tables]
    windows = (None, 0.4)
    vehicles = [VehicleTableOptions(min_samples=2, window=window) for window in windows]
    ngsim = [NgsimOptions(min_samples=2, dt=0.1, window=window) for window in windows]
    pairs = [PairOptions(), PairOptions(dt=0.4, window=0.8, min_samples=2)]
    juelich = JuelichOptions(frame_rate=None, unit=None, walls={"corridor": [0.0, 3.0]})
    traffic, crowd = TableOptions(domain="traffic"), TableOptions(domain="crowd")
    area = WalkwayOptions(path=str(CORPUS / "corridor.txt"), t_seq=1.0)
    of_area = _reads(area, key=GEOMETRY, **{PEOPLE: CORPUS / "corridor.txt"})
    of_walls = _reads(crowd, key=WALLS, **{TIDY: CORPUS / "crowd.csv"})

    def text(name: str, file: str, read: Callable[[Path], Any], *names: str) -> Target:
        """A target of malformed text files from those of the corpus."""
        return Target(name, file, damaged_text(*(sound[name] for name in names)), read)

    def binary(name: str, file: str, read: Callable[[Path], Any], *contents: bytes) -> Target:
        return Target(name, file, damaged_bytes(*contents), read)

    of_openacc = _reads(OpenAccOptions(min_duration=0.3), key="platoon.csv")
    checked = [*tables, "corridor.txt", "ngsim.csv", "openacc.csv", "openacc_flat.csv"]
    mats = _mat(packed=False), _mat(packed=True)
    sumo, fcd = _reads(SumoOptions(dt=0.5, min_samples=2)), sound["fcd.xml"]
    return [
        binary("esimas", "sequence_datademo.mat", _reads(EsimasOptions(), key="demo"), *mats),
        text("juelich", "corridor.txt", _reads(juelich), "corridor.txt"),
        text("table CSV", "table.csv", _reads(traffic, key=TIDY), "traffic.csv"),
        text("table CSV, crowd", "people.csv", _reads(crowd, key=TIDY), "crowd.csv"),
        binary("table Parquet", "table.parquet", _reads(traffic, key=TIDY), _parquet(frames[0])),
        text("vehicles CSV", "cars.csv", _reads(*vehicles), "vehicles.csv"),
        text("pairs CSV", "pairs.csv", _reads(*pairs, key="pairs.csv"), "pairs.csv"),
        text("OpenACC", "platoon.csv", of_openacc, "openacc.csv", "openacc_flat.csv"),
        text("NGSIM", "ngsim.csv", _reads(*ngsim), "ngsim.csv"),
        Target("highD, tracks", tracks, damaged_text((CORPUS / tracks).read_bytes()), _read_highd),
        Target("SUMO", "fcd.xml", damaged_text(fcd, gzip.compress(fcd)), sumo),
        binary(
            "JuPedSim",
            "walk.sqlite",
            _reads(WalkwayOptions(t_seq=1.0), key=PEOPLE),
            _walkway(scratch / "seed.sqlite"),
        ),
        text("walkable area", "area.wkt", of_area, "area.wkt"),
        Target("data frame", "frame.pickle", strange_frame(frames), _read_frame),
        text("check", "checked.csv", lambda path: repr(check_file(path)), *checked),
        text("walls CSV", "walls.csv", of_walls, "walls.csv"),
        binary("checkpoint, bytes", "bytes.pt", _read_checkpoint, checkpoint),
        Target(
            "checkpoint, evil", "evil.pt", evil_checkpoint(checkpoint, outside), _read_checkpoint
        ),
        Target("checkpoint, values", "values.pt", strange_checkpoint(checkpoint), _read_checkpoint),
        Target("formula", "law.txt", damaged_formula(*_FORMULAS), _read_formula),
        Target("store, manifest", f"manifest/{MANIFEST}", damaged_text(manifest), _read_store),
        Target("store, table", f"table/{TABLE}", damaged_bytes(table), _read_store),
        Target("kept result", f"kept/{KEPT}/one.json", damaged_text(kept), _read_kept),
    ]
