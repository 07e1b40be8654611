"""Run folders, checkpoints and prepared data of somebody else: a command that reads them runs
nothing of theirs, sends nothing away, and writes into its own folder only."""

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
from tests.app.conftest import Script
from tests.data.tables import saved, tidy

pytestmark = pytest.mark.thorough

Made = Callable[..., Path]

LAW = {
    "parameters": {"v0": "30 m/s", "T": "1.2 s"},
    "rate": {"v": "(v0*(1 - v*T/gap) - v)/T"},
    "step": "euler",
}


@pytest.fixture
def table(tmp_path: Path) -> Path:
    return saved(tmp_path / "cars.csv", tidy(samples=40, agents=3))


@pytest.fixture
def made(tmp_path: Path, table: Path) -> Made:
    """A checkpoint with other options than those of an honest one."""

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
        weights = {"terms.0.v0": 30.0, "terms.0.T": 1.2}
        model = {name: torch.tensor(value, dtype=torch.float64) for name, value in weights.items()}
        save_checkpoint(
            Checkpoint(
                config={**config, "seed": 0},
                manifest={},
                model=model,
                optimizer={},
                progress={"epoch": 1, "step": 1},
            ),
            path,
        )
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
def test_a_name_in_a_law_is_no_code(
    script: Script, made: Made, tmp_path: Path, kind: str, name: str
) -> None:
    entries = {"states": ["m/s", "0*v0/T", "0*v0"], "delayed": ["v", "m/s", "T"], "where": "gap"}
    law = {**LAW, "remembered": 1, kind: {"good": entries[kind]}}
    done = evaluated(script, made(law), tmp_path / "honest", NNODE_CACHE=str(tmp_path / "cache"))
    trap = tmp_path / "trap"
    code = f'__import__("pathlib").Path("{trap}").touch()'
    bad = made({**law, kind: {name.format(code): entries[kind]}})
    done = evaluated(script, bad, tmp_path / "out", 2, NNODE_CACHE=str(tmp_path / "cache"))
    assert not trap.exists()
    assert "cannot be a name" in done.stderr
    assert "Traceback" not in done.stderr


class Trap:
    """Unpickling this makes a file."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[object, tuple[object, ...]]:
        return Path.touch, (self.path,)


def callbacks(folder: Path, trap: Path) -> str:
    """A configuration that runs code at the start of a job."""
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
def test_a_run_brings_no_configuration(
    script: Script, made: Made, tmp_path: Path, command: str, option: str, group: str
) -> None:
    trap, base = tmp_path / "trap", {"data": "table", "solver": "fused"}[group]
    file = tmp_path / "theirs.yaml"
    file.write_text(
        f"# @package _global_\ndefaults: [/{group}/{base}@{group}]\n" + callbacks(tmp_path, trap)
    )
    up = "../" * 15 + str(file.with_suffix("")).lstrip("/")
    path = made(groups={group: up})
    done = script(command, option.format(path), f"hydra.run.dir={tmp_path / 'out'}", status=1)
    assert not trap.exists()
    assert f"and there is no such file in conf/{group}" in done.stderr


def test_nor_does_prepared_data(script: Script, table: Path, tmp_path: Path) -> None:
    store, trap = tmp_path / "store", tmp_path / "trap"
    words = ("data=table", f"data.path={table}", "data.domain=traffic")
    script("prepare_data", *words, f"hydra.run.dir={store}")
    (store / "worse.yaml").write_text("# @package _global_\n" + callbacks(store, trap))
    up = "../" * 15 + str(store).lstrip("/")
    (store / "evil.yaml").write_text(
        f"defaults:\n- table_schema\n- {up}/worse@_global_\n- _self_\ndomain: traffic\npath: x\n"
    )
    content = json.loads((store / "manifest.json").read_text())
    content["manifest"]["options"]["name"] = f"{up}/evil"
    (store / "manifest.json").write_text(json.dumps(content))
    words = (f"data.prepared={store}", "data.split.heldout=0", "trainer.max_epochs=1")
    # it is a table, whatever it is called
    script("train", "model=lin", *words, f"hydra.run.dir={tmp_path / 'out'}")
    assert not trap.exists()


@pytest.fixture
def asked() -> Iterator[tuple[str, list[str]]]:
    """The address of a server on this machine, and the paths that it was asked for."""
    paths: list[str] = []

    class Listener(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            paths.append(self.path)
            self.send_error(404)

        def log_message(self, *_: Any) -> None:
            pass

    server = HTTPServer(("127.0.0.1", 0), Listener)
    Thread(target=server.serve_forever, daemon=True).start()
    yield f"http://127.0.0.1:{server.server_port}", paths
    server.shutdown()


def test_the_environment_stays_here(
    script: Script, made: Made, tmp_path: Path, asked: tuple[str, list[str]]
) -> None:
    address, paths = asked
    secret = {"MY_SECRET": "opensesame", "no_proxy": "127.0.0.1"}
    away = {"name": "esimas", "recording": "1-1_1", "min_vehicles": 3, "path": None}
    for data in (
        {**away, "source": address + "/${oc.env:MY_SECRET}"},
        {"path": str(tmp_path / "${oc.env:MY_SECRET}.csv")},
        {"path": "${oc.decode:${oc.env:MY_SECRET}}"},
    ):
        path = made(data=data, groups={"data": data.get("name", "table")})
        done = evaluated(script, path, tmp_path / "out", 1, **secret)
        assert paths == []
        assert "opensesame" not in done.stderr + done.stdout
        assert "is refused: its configuration holds" in done.stderr


def test_a_model_s_name_is_no_path(script: Script, made: Made, tmp_path: Path) -> None:
    people = {
        **model_options("sf"),
        **{"name": "../../escaped", "A": 1.0, "k": 1.0, "kappa": 1.0, "walls": False},
    }
    path = made(model=people)
    content = torch.load(path, weights_only=True)
    content["config"]["data"]["recording"] = "all"
    content["model"] = dict(build_model(people, 0, torch.float64).state_dict())
    torch.save(content, path)
    out = tmp_path / "a" / "b" / "out"
    both = path.with_name("again.pt")  # the second one's name has its recording behind it
    content["config"]["data"]["recording"] = "/../../../recorded"
    torch.save(content, both)
    script("plot_forces", f"checkpoint=[{path},{both}]", f"hydra.run.dir={out}")
    result = [p for p in tmp_path.rglob("*") if "escaped" in p.name or "recorded" in p.name]
    assert len(result) == 8
    assert {p.parent for p in result} == {out}


def test_the_traps_work(tmp_path: Path) -> None:
    """What the tests above wait for does happen where it is allowed."""
    callbacks(tmp_path, tmp_path / "trap")
    pd.read_pickle(tmp_path / "data.bin")
    assert (tmp_path / "trap").exists()
