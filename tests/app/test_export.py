"""Exporting a run: every target from end to end, and what is refused."""

from __future__ import annotations

import json
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pandas as pd
import pytest

import nnode
from nnode.app.cli.saved import checkpoint_of, saved_groups
from nnode.app.export import (
    TARGETS,
    intervals_of,
    targets_of,
)
from nnode.calibrate.checkpoint import load_checkpoint
from nnode.data.readers.juelich import JuelichOptions, read_juelich
from nnode.data.readers.sumo import SumoOptions, read_sumo
from nnode.data.readers.table import TableOptions, read_table
from nnode.errors import CheckpointError, ConfigError
from nnode.model import Traffic, make_law
from nnode.model.system import Crowd
from tests.app.conftest import Script


def trained(script: Script, raw: Path, domain: str, model: str) -> Path:
    """The folder of a short training."""
    folder = raw.with_name(f"{raw.name}-{domain}")
    script(
        "train",
        f"experiment=demo_{domain}",
        f"model={model}",
        "trainer.max_epochs=2",
        f"data.source={raw}",
        f"hydra.run.dir={folder}",
    )
    return folder


@pytest.mark.thorough
def test_traffic_with_all_that_fits(script: Script, raw: Path, tmp_path: Path) -> None:
    traffic = trained(script, raw, "traffic", "lin")
    done = script("export", f"run={traffic}", f"hydra.run.dir={tmp_path}")
    account = json.loads((tmp_path / "export.json").read_text())
    assert list(account["written"]) == ["sumo", "fcd", "parquet", "csv"]
    for entry in account["written"].values():
        for name in entry["files"]:
            assert (tmp_path / name).is_file()
    assert "no counterpart: " in done.stdout

    model = nnode.load(checkpoint_of(str(traffic)))
    known = {name: float(value) for name, (value, _) in model.physical().items()}
    table = pd.read_csv(tmp_path / "csv" / "parameters.csv").set_index("parameter")
    assert table["value"].to_dict() == pytest.approx(known, rel=1e-15)
    assert table["unit"].to_dict() == {"lin.v0": "m/s", "lin.L": "m"}
    (kind,) = ElementTree.parse(tmp_path / "vtype.add.xml").iter("vType")
    room = float(kind.attrib["length"]) + float(kind.attrib["minGap"])
    assert room == pytest.approx(known["lin.L"], rel=1e-5)

    measured, simulated = (
        read_table(path, TableOptions(domain="traffic", path=str(path)))
        for path in (tmp_path / "measured.parquet", tmp_path / "simulated.parquet")
    )
    assert len(measured) == account["sequences"]
    errors: dict[int, list[float]] = {}
    for a, b in zip(measured, simulated, strict=True):
        assert (a.name, a.agents) == (b.name, b.agents)
        np.testing.assert_array_equal(a.x[0], b.x[0])
        for k in range(1, a.n_samples):
            errors.setdefault(k, []).extend(((a.x[k] - b.x[k]) ** 2).ravel())
    lane = SumoOptions(path="", dt=measured[0].dt, min_vehicles=1, min_samples=2, window=None)
    repeated = {s.recording: s.x for s in read_sumo(tmp_path / "simulated.xml.gz", lane)}
    for s in simulated:
        name = s.name.replace("/", "_")
        np.testing.assert_allclose(repeated[f"simulated_{name}"], s.x, rtol=0, atol=1e-9)
    horizons = pd.read_csv(tmp_path / "csv" / "horizons.csv")
    expected = [np.sqrt(np.mean(errors[k])) for k in sorted(errors)]
    np.testing.assert_allclose(horizons["rmse_m"], expected, rtol=1e-9)
    history = pd.read_csv(tmp_path / "csv" / "history.csv")
    assert {"cost/train", "cost/heldout", "parameters/lin.v0"} <= set(history["quantity"])


@pytest.mark.thorough
def test_idm_s_vehicle_type_has_the_run_s_intervals(
    script: Script, idm_run: Path, tmp_path: Path
) -> None:
    result = json.loads((idm_run / "result.json").read_text())["parameters"]
    script("export", f"run={idm_run}", "to=sumo", f"hydra.run.dir={tmp_path}")
    text = (tmp_path / "vtype.add.xml").read_text()
    known = [name for name, own in result.items() if own["low"] is not None]
    assert known
    for name in known:
        own = result[name]
        short = name.rpartition(".")[2]
        interval = f"95 % [{own['low']:.6g}, {own['high']:.6g}]"
        assert f"<!-- {short} = {own['value']:.6g} {own['unit']}, {interval} -->" in text
    assert intervals_of(str(idm_run)) == result
    assert intervals_of(str(tmp_path)) == {}


@pytest.mark.slow
def test_crowd_held_out_and_simulated(script: Script, raw: Path, tmp_path: Path) -> None:
    crowd = trained(script, raw, "crowd", "sf")
    script(
        "export",
        f"run={crowd}",
        "to=[pedpy,jupedsim,csv]",
        "part=heldout",
        "trajectories=simulated",
        f"hydra.run.dir={tmp_path}",
    )
    heldout = load_checkpoint(checkpoint_of(str(crowd))).split["heldout"]
    files = sorted((tmp_path / "pedpy" / "simulated").iterdir())
    assert len(files) == len(heldout) > 0
    assert not (tmp_path / "pedpy" / "measured").exists()
    assert read_juelich(files[0], JuelichOptions(t_seq=0.04))[0].dt == pytest.approx(0.04)
    table = pd.read_csv(tmp_path / "csv" / "sequences.csv")
    assert sorted(table["sequence"]) == sorted(heldout)
    assert set(table["part"]) == {"heldout"}

    content = json.loads((tmp_path / "jupedsim.json").read_text())
    model = nnode.load(checkpoint_of(str(crowd)))
    known = {name: float(value) for name, (value, _) in model.physical().items()}
    assert content["agent"]["agent_scale"] == pytest.approx(known["social_force.A"])
    assert content["model"] == pytest.approx(
        {"body_force": known["social_force.k"], "friction": known["social_force.kappa"]}
    )
    assert content["agent"]["obstacle_scale"] > 0


def test_one_clear_error(script: Script, idm_run: Path, tmp_path: Path) -> None:
    options = (f"run={idm_run}", "to=[csv,jupedsim]", f"hydra.run.dir={tmp_path}")
    done = script("export", *options, status=2)
    assert "Traceback" not in done.stderr
    errors = [line for line in done.stderr.splitlines() if line.startswith("error: ")]
    assert len(errors) == 1, done.stderr
    assert "to=jupedsim" in errors[0]
    assert "no social force" in errors[0]
    assert not (tmp_path / "export.json").exists()


def test_which_targets_fit() -> None:
    force = make_law("social_force", A=1.0, k=1.0, kappa=1.0)
    assert targets_of("auto", Traffic([make_law("lin")])) == ["sumo", "fcd", "parquet", "csv"]
    assert targets_of("auto", Crowd([force])) == ["jupedsim", "pedpy", "parquet", "csv"]
    assert targets_of("auto", Crowd([make_law("relaxation"), make_law("network_force")])) == [
        "pedpy",
        "parquet",
        "csv",
    ]
    assert targets_of(["csv", "pedpy"], Crowd([force])) == ["pedpy", "csv"]
    assert targets_of("sumo", Crowd([force])) == ["sumo"]  # refused later, with the reason
    with pytest.raises(ConfigError, match="to=fcd is not for crowd"):
        targets_of(["csv", "fcd"], Crowd([force]))
    for asked in ("vadere", ["csv", "vadere"], [], None):
        with pytest.raises(ConfigError, match=", ".join(TARGETS)):
            targets_of(asked, Crowd([force]))


def test_a_run_is_named_by_folder_or_checkpoint(tmp_path: Path) -> None:
    assert checkpoint_of(str(tmp_path)) == tmp_path / "checkpoints" / "best.pt"
    assert checkpoint_of(str(tmp_path / "last.pt")) == tmp_path / "last.pt"
    with pytest.raises(CheckpointError, match=r"no checkpoint .*best\.pt"):
        saved_groups([f"run={tmp_path}"], "run")
    assert saved_groups(["to=csv"], "run") == []


def test_the_run_s_own_data_and_solver_are_chosen(idm_run: Path) -> None:
    run, groups = f"run={idm_run}", ("data", "solver")
    assert saved_groups([run], "run", groups) == ["data=table", "solver=fused"]
    assert saved_groups([run, "solver=torchdiffeq"], "run", groups) == ["data=table"]
