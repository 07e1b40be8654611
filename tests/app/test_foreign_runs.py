"""Checkpoints and prepared data from untrusted sources: commands run no code of theirs, send no
data, and write only into their own folder."""

from __future__ import annotations

import json
import pickle
import subprocess
from collections.abc import Callable, Iterator
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path
from threading import Thread
from typing import Any

import pandas as pd
import pytest
import torch

from nnode.app.python.inputs import model_options
from nnode.calibrate.checkpoint import Checkpoint, save_checkpoint
from nnode.model import build_model
from tests.app.conftest import Script, read_json
from tests.data.tables import saved, tidy

pytestmark = pytest.mark.thorough

MakeCheckpoint = Callable[..., Path]

LAW = {
    "parameters": {"v0": "30 m/s", "T": "1.2 s"},
    "rate": {"v": "(v0*(1 - v*T/gap) - v)/T"},
    "step": "euler",
}


@pytest.fixture
def table(tmp_path: Path) -> Path:
    return saved(tmp_path / "cars.csv", tidy(samples=40, agents=3))


@pytest.fixture
def make_checkpoint(tmp_path: Path, table: Path) -> MakeCheckpoint:
    """Returns a function that saves a checkpoint with changed options."""

    def make(law: dict[str, Any] = LAW, **sections: dict[str, Any]) -> Path:
        config = {
            "model": {
                **model_options({"term": "formula", "law": LAW}, "measured"),
                **{"name": "mine", "law": law},
            },
            "data": {"name": "table", "domain": "traffic", "path": str(table), "faults": "drop"},
            "solver": {"name": "fused", "dt": None, "method": None, "threads": 1},
            "optimizer": {"name": "gauss_newton"},
            "trainer": {"dtype": "float64", "threads": None, "cost": "integral", "device": "cpu"},
            "groups": {
                "model": "formula",
                "data": "table",
                "solver": "fused",
                "optimizer": "gauss_newton",
            },
        }
        config = {key: {**value, **sections.get(key, {})} for key, value in config.items()}
        config["data"] = {k: v for k, v in config["data"].items() if v is not None}
        path = tmp_path / "theirs" / "checkpoints" / "best.pt"
        path.parent.mkdir(parents=True, exist_ok=True)
        checkpoint = Checkpoint(
            config={**config, "seed": 0},
            manifest={},
            model={
                "terms.0.v0": torch.tensor(30.0, dtype=torch.float64),
                "terms.0.T": torch.tensor(1.2, dtype=torch.float64),
            },
            optimizer={},
            progress={"epoch": 1, "step": 1},
        )
        save_checkpoint(checkpoint, path)
        return path

    return make


def evaluated(
    script: Script, path: Path, folder: Path, status: int = 0, **env: str
) -> subprocess.CompletedProcess[str]:
    words = (f"checkpoint={path}", "part=all", "replay=false", f"hydra.run.dir={folder}")
    return script("evaluate", *words, status=status, **env)


@pytest.mark.parametrize(
    ("kind", "name"),
    [("states", "a: {}"), ("states", "[{}]"), ("delayed", "[{}].b"), ("where", "a=[{}]")],
)
def test_names_in_a_law_are_not_executed(
    script: Script, make_checkpoint: MakeCheckpoint, tmp_path: Path, kind: str, name: str
) -> None:
    entries = {"states": ["m/s", "0*v0/T", "0*v0"], "delayed": ["v", "m/s", "T"], "where": "gap"}
    law = {**LAW, "remembered": 1, kind: {"good": entries[kind]}}
    cache = str(tmp_path / "cache")
    evaluated(script, make_checkpoint(law), tmp_path / "harmless", NNODE_CACHE=cache)
    trap = tmp_path / "trap"
    code = f'__import__("pathlib").Path("{trap}").touch()'
    malicious = make_checkpoint({**law, kind: {name.format(code): entries[kind]}})
    done = evaluated(script, malicious, tmp_path / "out", 2, NNODE_CACHE=cache)
    assert not trap.exists()
    assert "cannot be a name" in done.stderr
    assert "Traceback" not in done.stderr


class Trap:
    """Creates a file when it is unpickled."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[object, tuple[object, ...]]:
        return Path.touch, (self.path,)


def callbacks(folder: Path, trap: Path) -> str:
    """A configuration that unpickles a `Trap` at the start of a job."""
    (folder / "data.bin").write_bytes(pickle.dumps(Trap(trap)))
    return (
        "hydra:\n  callbacks:\n    one:\n      _target_: pandas.read_pickle\n"
        f"      filepath_or_buffer: {folder / 'data.bin'}\n"
    )


@pytest.mark.parametrize(
    ("command", "option", "group"),
    [
        ("evaluate", "checkpoint={}", "solver"),
        ("evaluate", "checkpoint={}", "data"),
        ("export", "run={}", "solver"),
        ("simulate", "run={}", "data"),
        ("train", "resume={}", "solver"),
        ("plot_forces", "checkpoint={}", "data"),
    ],
)
def test_checkpoint_cannot_name_a_configuration_file(
    script: Script,
    make_checkpoint: MakeCheckpoint,
    tmp_path: Path,
    command: str,
    option: str,
    group: str,
) -> None:
    trap, base = tmp_path / "trap", {"data": "table", "solver": "fused"}[group]
    file = tmp_path / "theirs.yaml"
    file.write_text(
        f"# @package _global_\ndefaults: [/{group}/{base}@{group}]\n" + callbacks(tmp_path, trap)
    )
    up = "../" * 15 + str(file.with_suffix("")).lstrip("/")
    path = make_checkpoint(groups={group: up})
    done = script(command, option.format(path), folder=tmp_path / "out", status=1)
    assert not trap.exists()
    assert f"and there is no such file in conf/{group}" in done.stderr


def test_prepared_data_cannot_name_a_configuration_file(
    script: Script, table: Path, tmp_path: Path
) -> None:
    store, trap = tmp_path / "store", tmp_path / "trap"
    words = ("data=table", f"data.path={table}", "data.domain=traffic")
    script("prepare_data", *words, folder=store)
    (store / "worse.yaml").write_text("# @package _global_\n" + callbacks(store, trap))
    up = "../" * 15 + str(store).lstrip("/")
    (store / "evil.yaml").write_text(
        f"defaults:\n- table_schema\n- {up}/worse@_global_\n- _self_\ndomain: traffic\npath: x\n"
    )
    content = read_json(store / "manifest.json")
    content["manifest"]["options"]["name"] = f"{up}/evil"
    (store / "manifest.json").write_text(json.dumps(content))
    words = (f"data.prepared={store}", "data.split.heldout=0", "trainer.max_epochs=1")
    # the data are read as a table
    script("train", "model=lin", *words, folder=tmp_path / "out")
    assert not trap.exists()


@pytest.fixture
def server() -> Iterator[tuple[str, list[str]]]:
    """The address of a local server, and the paths of the requests that it received."""
    paths: list[str] = []

    class Listener(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            paths.append(self.path)
            self.send_error(404)

        def log_message(self, *_: Any) -> None:
            pass

    http = HTTPServer(("127.0.0.1", 0), Listener)
    Thread(target=http.serve_forever, daemon=True).start()
    yield f"http://127.0.0.1:{http.server_port}", paths
    http.shutdown()


def test_environment_variables_are_not_sent(
    script: Script, make_checkpoint: MakeCheckpoint, tmp_path: Path, server: tuple[str, list[str]]
) -> None:
    address, requests = server
    secret = {"MY_SECRET": "opensesame", "no_proxy": "127.0.0.1"}
    remote = {"name": "esimas", "recording": "1-1_1", "min_vehicles": 3, "path": None}
    for data in (
        {**remote, "source": address + "/${oc.env:MY_SECRET}"},
        {"path": str(tmp_path / "${oc.env:MY_SECRET}.csv")},
        {"path": "${oc.decode:${oc.env:MY_SECRET}}"},
    ):
        path = make_checkpoint(data=data, groups={"data": data.get("name", "table")})
        done = evaluated(script, path, tmp_path / "out", 1, **secret)
        assert requests == []
        assert "opensesame" not in done.stderr + done.stdout
        assert "is refused: its configuration holds" in done.stderr


def test_model_name_is_not_used_as_a_path(
    script: Script, make_checkpoint: MakeCheckpoint, tmp_path: Path
) -> None:
    people = {
        **model_options("sf"),
        **{"name": "../../escaped", "A": 1.0, "k": 1.0, "kappa": 1.0, "walls": False},
    }
    path = make_checkpoint(model=people)
    content = torch.load(path, weights_only=True)
    content["config"]["data"]["recording"] = "all"
    content["model"] = dict(build_model(people, 0, torch.float64).state_dict())
    torch.save(content, path)
    out = tmp_path / "a" / "b" / "out"
    second = path.with_name("second.pt")  # its recording is appended to its name
    content["config"]["data"]["recording"] = "/../../../recorded"
    torch.save(content, second)
    script("plot_forces", f"checkpoint=[{path},{second}]", folder=out)
    files = [p for p in tmp_path.rglob("*") if "escaped" in p.name or "recorded" in p.name]
    assert len(files) == 8
    assert {p.parent for p in files} == {out}


def test_trap_works_where_unpickling_is_allowed(tmp_path: Path) -> None:
    callbacks(tmp_path, tmp_path / "trap")
    pd.read_pickle(tmp_path / "data.bin")
    assert (tmp_path / "trap").exists()
