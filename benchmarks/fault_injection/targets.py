"""What is fuzzed: each reader and each loader, and the malformed files that it is given."""

from __future__ import annotations

import copy
import io
import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch
from hypothesis.strategies import SearchStrategy
from omegaconf import MISSING
from scipy.io import savemat

from benchmarks.fault_injection import formats
from benchmarks.fault_injection.damage import (
    damaged_bytes,
    damaged_formula,
    damaged_text,
    evil_checkpoint,
    strange_checkpoint,
    strange_frame,
)
from benchmarks.fault_injection.formats import read_all
from nnode.app.check import check_file
from nnode.calibrate.checkpoint import Checkpoint, load_checkpoint, save_checkpoint
from nnode.calibrate.optimizers import AdadeltaOptions, build_optimizer
from nnode.data.options import DataOptions
from nnode.data.readers.esimas import EsimasOptions
from nnode.data.readers.highd import TRACKS
from nnode.data.readers.juelich import JuelichOptions
from nnode.data.readers.jupedsim import GEOMETRY, PEOPLE, WalkwayOptions
from nnode.data.readers.ngsim import NgsimOptions
from nnode.data.readers.openacc import OpenAccOptions
from nnode.data.readers.pairs import PairOptions
from nnode.data.readers.sumo import SumoOptions
from nnode.data.readers.table import TABLE as TIDY
from nnode.data.readers.table import WALLS, TableOptions
from nnode.data.readers.vehicles import VehicleTableOptions
from nnode.data.sequence import Sequence
from nnode.data.store import MANIFEST, TABLE, Store, write_store
from nnode.model import Traffic, build_model
from nnode.model.laws import law_from
from nnode.simulation.kernels import source
from studies.runner import KEPT, Task, run_tasks

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


def _trajectories() -> pd.DataFrame:
    rows = [
        {
            "sequence": s,
            "time": 0.2 * k,
            "agent": f"a{n}",
            "x": 20.0 * n + 3.0 * k,
            "y": 1.0 * n,
            "length": 4.5,
            "kind": "car",
            "group": "",
            "dest_x": 90.0,
            "dest_y": 1.0 * n,
        }
        for s in ("one", "two")
        for k in range(4)
        for n in range(3)
    ]
    return pd.DataFrame(rows)


def _vehicles() -> pd.DataFrame:
    rows = [
        {
            "vehicle": n,
            "time": 0.2 * k,
            "x": 20.0 * n + 3.0 * k,
            "lane": 1,
            "speed": 15.0,
            "length": 4.5,
            "kind": 2,
        }
        for n in range(4)
        for k in range(5)
    ]
    return pd.DataFrame(rows)


def _pairs() -> pd.DataFrame:
    rows = [
        {
            "pair": n,
            "time": 0.2 * k,
            "x_follower": 3.0 * k,
            "v_follower": 15.0,
            "x_leader": 20.0 + 3.0 * k,
            "v_leader": 15.0,
            "spacing": 15.5,
            "follower": n,
            "leader": 9,
            "run": "a",
            "split": "train",
        }
        for n in range(2)
        for k in range(6)
    ]
    return pd.DataFrame(rows)


def _platoon() -> bytes:
    head = [
        "Date,8,10,2019",
        "Vehicle_order,A,B",
        "Number_of_vehicles,2",
        "ACC,1",
        "Distance_setting,S",
        "Time,Speed1,E1,N1,Speed2,E2,N2,IVS1",
    ]
    rows = [f"{5 + 0.1 * k:.1f},10,{k},0,10.1,{k - 20},0,{15 - 0.01 * k:.2f}" for k in range(9)]
    return ("\n".join([*head, *rows]) + "\n").encode()


def _csv(frame: pd.DataFrame) -> bytes:
    return str(frame.to_csv(index=False)).encode()


def _parquet(frame: pd.DataFrame) -> bytes:
    made = io.BytesIO()
    frame.to_parquet(made, index=False)
    return made.getvalue()


def _mat(*, packed: bool) -> bytes:
    cells = np.empty((1, 2), dtype=object)
    for i in range(2):
        x = 20.0 * np.arange(3)[:, None] + 3.0 * np.arange(4)
        cells[0, i] = {"Xarr": x, "Tarr": 0.2 * np.arange(4)[None]}
    made = io.BytesIO()
    savemat(made, {"sequences": cells}, do_compression=packed)
    return made.getvalue()


def _corridor() -> bytes:
    lines = ["# framerate: 16", "# id frame x/m y/m z/m"]
    lines += [f"{n} {k} {0.1 * k + n:.3f} {0.5 * n:.3f} 1.7" for n in (1, 2) for k in range(40)]
    return ("\n".join(lines) + "\n").encode()


def _checkpoint(scratch: Path) -> bytes:
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
    save_checkpoint(checkpoint, scratch / "seed.pt")
    return (scratch / "seed.pt").read_bytes()


def _open_checkpoint(path: Path) -> None:
    checkpoint = load_checkpoint(path)
    checkpoint.build()


def _store(scratch: Path) -> tuple[bytes, bytes]:
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
    write_store(scratch, items, {"domain": "crowd", "dt": 0.1})
    return (scratch / MANIFEST).read_bytes(), (scratch / TABLE).read_bytes()


def _read_store(path: Path) -> None:
    for item in Store(path.parent):
        item.velocity()


def one(x: float) -> dict[str, Any]:
    """A task whose kept result is damaged."""
    return {"x": x}


def _read_kept(path: Path) -> None:
    task = Task("one", one, {"x": 1.0})
    found = run_tasks([task], path.parent.parent, workers=1, fingerprint="f")
    assert found == {"one": {"x": 1.0}} or json.loads(path.read_text())["result"] == found["one"]


def _read_formula(path: Path) -> None:
    """A law and its compiled form, up to the source text."""
    text = path.read_bytes().decode(errors="replace")
    model = Traffic([law_from("law", {"parameters": _QUANTITIES, "rate": {"v": text}})])
    compile(source(model), "law", "exec")


def targets(scratch: Path) -> list[Target]:
    """All targets.

    Args:
        scratch: receives the sound files, and the store whose files are damaged; evil files try to
            write beside it.
    """
    outside = scratch.with_name(OUTSIDE)
    traffic = _trajectories().drop(columns=["y", "dest_y", "dest_x"])
    crowd, walls = (
        _trajectories().assign(x=lambda f: f["x"] / 15),
        b"x1,y1,x2,y2\n0,0,5,0\n5,2,0,2\n",
    )
    of_traffic, of_crowd = TableOptions(domain="traffic"), TableOptions(domain="crowd")
    (scratch / "crowd.csv").write_bytes(_csv(crowd))
    manifest, table = _store(scratch / "manifest")
    (scratch / "table").mkdir()
    (scratch / "table" / MANIFEST).write_bytes(manifest)
    (scratch / "kept" / KEPT).mkdir(parents=True)
    run_tasks([Task("one", one, {"x": 1.0})], scratch / "kept", workers=1, fingerprint="f")
    kept = (scratch / "kept" / KEPT / "one.json").read_bytes()
    checkpoint = _checkpoint(scratch)
    pandas_only = JuelichOptions(frame_rate=None, unit=None, walls={"corridor": [0.0, 3.0]})
    tracks = formats.highd(scratch / "highd")
    (scratch / "room.txt").write_bytes(_corridor())
    frames = [traffic, crowd, _vehicles(), _pairs()]
    texts = [_csv(frame) for frame in frames]
    texts += [_corridor(), formats.ngsim(), _platoon(), formats.flat_platoons()]

    def reads(*every: DataOptions, key: str | None = None, **more: Path) -> Callable[[Path], None]:
        """A reader of a file, once with each of the options.

        Args:
            key: of the file among those that are read; by default its stem.
            more: further files, which are sound.
        """

        def read(path: Path) -> None:
            for options in every:
                given = copy.copy(options)
                if vars(given).get("path", MISSING) == MISSING:
                    vars(given)["path"] = str(path)
                read_all(given, {**more, key or path.stem: path})

        return read

    windows = (None, 0.4)
    area = WalkwayOptions(path=str(scratch / "room.txt"), t_seq=1.0)
    fcd = SumoOptions(dt=0.5, min_samples=2)
    vehicles = [VehicleTableOptions(min_samples=2, window=window) for window in windows]
    pairs = [PairOptions(), PairOptions(dt=0.4, window=0.8, min_samples=2)]
    ngsim = [NgsimOptions(min_samples=2, dt=0.1, window=window) for window in windows]
    return [
        Target(
            "esimas",
            "sequence_datademo.mat",
            damaged_bytes(_mat(packed=False), _mat(packed=True)),
            reads(EsimasOptions(), key="demo"),
        ),
        Target("juelich", "corridor.txt", damaged_text(_corridor()), reads(pandas_only)),
        Target("table CSV", "table.csv", damaged_text(_csv(traffic)), reads(of_traffic, key=TIDY)),
        Target(
            "table CSV, crowd", "people.csv", damaged_text(_csv(crowd)), reads(of_crowd, key=TIDY)
        ),
        Target(
            "table Parquet",
            "table.parquet",
            damaged_bytes(_parquet(traffic)),
            reads(of_traffic, key=TIDY),
        ),
        Target("vehicles CSV", "cars.csv", damaged_text(_csv(_vehicles())), reads(*vehicles)),
        Target(
            "pairs CSV", "pairs.csv", damaged_text(_csv(_pairs())), reads(*pairs, key="pairs.csv")
        ),
        Target(
            "OpenACC",
            "platoon.csv",
            damaged_text(_platoon(), formats.flat_platoons()),
            reads(OpenAccOptions(min_duration=0.3), key="platoon.csv"),
        ),
        Target("NGSIM", "ngsim.csv", damaged_text(formats.ngsim()), reads(*ngsim)),
        Target("highD, tracks", f"highd/01{TRACKS}", damaged_text(tracks), formats.read_highd),
        Target("SUMO", "fcd.xml", damaged_text(*formats.sumo()), reads(fcd)),
        Target(
            "JuPedSim",
            "walk.sqlite",
            damaged_bytes(formats.walkway(scratch)),
            reads(WalkwayOptions(t_seq=1.0), key=PEOPLE),
        ),
        Target(
            "walkable area",
            "area.wkt",
            damaged_text(formats.ROOM.encode()),
            reads(area, key=GEOMETRY, **{PEOPLE: scratch / "room.txt"}),
        ),
        Target("data frame", "frame.pickle", strange_frame(frames), formats.read_frame),
        Target("check", "checked.csv", damaged_text(*texts), lambda path: repr(check_file(path))),
        Target(
            "walls CSV",
            "walls.csv",
            damaged_text(walls),
            reads(of_crowd, key=WALLS, **{TIDY: scratch / "crowd.csv"}),
        ),
        Target("checkpoint, bytes", "bytes.pt", damaged_bytes(checkpoint), _open_checkpoint),
        Target(
            "checkpoint, evil", "evil.pt", evil_checkpoint(checkpoint, outside), _open_checkpoint
        ),
        Target("checkpoint, values", "values.pt", strange_checkpoint(checkpoint), _open_checkpoint),
        Target("formula", "law.txt", damaged_formula(*_FORMULAS), _read_formula),
        Target("store, manifest", f"manifest/{MANIFEST}", damaged_text(manifest), _read_store),
        Target("store, table", f"table/{TABLE}", damaged_bytes(table), _read_store),
        Target("kept result", f"kept/{KEPT}/one.json", damaged_text(kept), _read_kept),
    ]


def quiet() -> None:
    """One thread, and no words from the libraries, which would cost more than the reading."""
    import logging
    import warnings

    torch.set_num_threads(1)
    logging.disable(logging.CRITICAL)
    warnings.simplefilter("ignore")
