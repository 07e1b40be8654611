"""Exporting a run: every target from end to end, and refused targets."""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pandas as pd
import pytest

import nnode
from nnode.app.cli.saved import checkpoint_of, saved_groups
from nnode.app.export import TARGETS, intervals_of, targets_of
from nnode.calibrate.checkpoint import load_checkpoint
from nnode.data.readers.juelich import JuelichOptions, read_juelich
from nnode.data.readers.sumo import SumoOptions, read_sumo
from nnode.data.readers.table import TableOptions, read_table
from nnode.errors import CheckpointError, ConfigError
from nnode.model import Traffic, make_law
from nnode.model.system import Crowd
from tests.app.conftest import Script, read_json


def trained(script: Script, raw: Path, domain: str, model: str) -> Path:
    """The folder of a short training."""
    folder = raw.with_name(f"{raw.name}-{domain}")
    options = f"experiment=demo_{domain} model={model} trainer.max_epochs=2 data.source={raw}"
    script("train", *options.split(), folder=folder)
    return folder


def parameters(run: Path) -> dict[str, float]:
    model = nnode.load(checkpoint_of(str(run)))
    return {name: float(value) for name, (value, _) in model.physical().items()}


@pytest.mark.thorough
def test_export_of_traffic_to_all_targets(script: Script, raw: Path, tmp_path: Path) -> None:
    traffic = trained(script, raw, "traffic", "lin")
    done = script("export", f"run={traffic}", folder=tmp_path)
    summary = read_json(tmp_path / "export.json")
    assert list(summary["written"]) == ["sumo", "fcd", "parquet", "csv"]
    for entry in summary["written"].values():
        for name in entry["files"]:
            assert (tmp_path / name).is_file()
    assert "no counterpart: " in done.stdout

    values = parameters(traffic)
    table = pd.read_csv(tmp_path / "csv" / "parameters.csv").set_index("parameter")
    assert table["value"].to_dict() == pytest.approx(values, rel=1e-15)
    assert table["unit"].to_dict() == {"lin.v0": "m/s", "lin.L": "m"}
    (kind,) = ElementTree.parse(tmp_path / "vtype.add.xml").iter("vType")
    length = float(kind.attrib["length"]) + float(kind.attrib["minGap"])
    assert length == pytest.approx(values["lin.L"], rel=1e-5)

    measured, simulated = (
        read_table(path, TableOptions(domain="traffic", path=str(path)))
        for path in (tmp_path / "measured.parquet", tmp_path / "simulated.parquet")
    )
    assert len(measured) == summary["sequences"]
    errors: dict[int, list[float]] = {}
    for a, b in zip(measured, simulated, strict=True):
        assert (a.name, a.agents) == (b.name, b.agents)
        np.testing.assert_array_equal(a.x[0], b.x[0])
        for k in range(1, a.n_samples):
            errors.setdefault(k, []).extend(((a.x[k] - b.x[k]) ** 2).ravel())
    lane = SumoOptions(path="", dt=measured[0].dt, min_vehicles=1, min_samples=2, window=None)
    positions = {s.recording: s.x for s in read_sumo(tmp_path / "simulated.xml.gz", lane)}
    for s in simulated:
        name = s.name.replace("/", "_")
        np.testing.assert_allclose(positions[f"simulated_{name}"], s.x, rtol=0, atol=1e-9)
    horizons = pd.read_csv(tmp_path / "csv" / "horizons.csv")
    expected = [np.sqrt(np.mean(errors[k])) for k in sorted(errors)]
    np.testing.assert_allclose(horizons["rmse_m"], expected, rtol=1e-9)
    history = pd.read_csv(tmp_path / "csv" / "history.csv")
    assert {"cost/train", "cost/heldout", "parameters/lin.v0"} <= set(history["quantity"])


@pytest.mark.thorough
def test_vehicle_type_has_the_intervals_of_the_run(
    script: Script, idm_run: Path, tmp_path: Path
) -> None:
    result = read_json(idm_run / "result.json")["parameters"]
    script("export", f"run={idm_run}", "to=sumo", folder=tmp_path)
    text = (tmp_path / "vtype.add.xml").read_text()
    estimated = {name: row for name, row in result.items() if row["low"] is not None}
    assert estimated
    for name, row in estimated.items():
        short = name.rpartition(".")[2]
        interval = f"95 % [{row['low']:.6g}, {row['high']:.6g}]"
        assert f"<!-- {short} = {row['value']:.6g} {row['unit']}, {interval} -->" in text
    assert intervals_of(str(idm_run)) == result
    assert intervals_of(str(tmp_path)) == {}


@pytest.mark.slow
def test_export_of_simulated_held_out_crowd(script: Script, raw: Path, tmp_path: Path) -> None:
    crowd = trained(script, raw, "crowd", "sf")
    script(
        "export",
        f"run={crowd}",
        "to=[pedpy,jupedsim,csv]",
        "part=heldout",
        "trajectories=simulated",
        folder=tmp_path,
    )
    heldout = load_checkpoint(checkpoint_of(str(crowd))).split["heldout"]
    files = sorted((tmp_path / "pedpy" / "simulated").iterdir())
    assert len(files) == len(heldout) > 0
    assert not (tmp_path / "pedpy" / "measured").exists()
    assert read_juelich(files[0], JuelichOptions(t_seq=0.04))[0].dt == pytest.approx(0.04)
    table = pd.read_csv(tmp_path / "csv" / "sequences.csv")
    assert sorted(table["sequence"]) == sorted(heldout)
    assert set(table["part"]) == {"heldout"}

    content = read_json(tmp_path / "jupedsim.json")
    values = parameters(crowd)
    assert content["agent"]["agent_scale"] == pytest.approx(values["social_force.A"])
    assert content["model"] == pytest.approx(
        {"body_force": values["social_force.k"], "friction": values["social_force.kappa"]}
    )
    assert content["agent"]["obstacle_scale"] > 0


def test_unsuitable_target_gives_one_error(script: Script, idm_run: Path, tmp_path: Path) -> None:
    options = (f"run={idm_run}", "to=[csv,jupedsim]", f"hydra.run.dir={tmp_path}")
    done = script("export", *options, status=2)
    assert "Traceback" not in done.stderr
    errors = [line for line in done.stderr.splitlines() if line.startswith("error: ")]
    assert len(errors) == 1, done.stderr
    assert "to=jupedsim" in errors[0]
    assert "no social force" in errors[0]
    assert not (tmp_path / "export.json").exists()


def test_targets_of_a_model() -> None:
    crowd = Crowd([make_law("social_force", A=1.0, k=1.0, kappa=1.0)])
    network = Crowd([make_law("relaxation"), make_law("network_force")])
    assert targets_of("auto", Traffic([make_law("lin")])) == ["sumo", "fcd", "parquet", "csv"]
    assert targets_of("auto", crowd) == ["jupedsim", "pedpy", "parquet", "csv"]
    assert targets_of("auto", network) == ["pedpy", "parquet", "csv"]
    assert targets_of(["csv", "pedpy"], crowd) == ["pedpy", "csv"]
    assert targets_of("sumo", crowd) == ["sumo"]  # refused later, with the reason
    with pytest.raises(ConfigError, match="to=fcd is not for crowd"):
        targets_of(["csv", "fcd"], crowd)
    for unknown in ("vadere", ["csv", "vadere"], [], None):
        with pytest.raises(ConfigError, match=", ".join(TARGETS)):
            targets_of(unknown, crowd)


def test_run_is_given_by_folder_or_checkpoint(tmp_path: Path) -> None:
    assert checkpoint_of(str(tmp_path)) == tmp_path / "checkpoints" / "best.pt"
    assert checkpoint_of(str(tmp_path / "last.pt")) == tmp_path / "last.pt"
    with pytest.raises(CheckpointError, match=r"no checkpoint .*best\.pt"):
        saved_groups([f"run={tmp_path}"], "run")
    assert saved_groups(["to=csv"], "run") == []


def test_groups_of_the_run_are_selected(idm_run: Path) -> None:
    run, groups = f"run={idm_run}", ("data", "solver")
    assert saved_groups([run], "run", groups) == ["data=table", "solver=fused"]
    assert saved_groups([run, "solver=torchdiffeq"], "run", groups) == ["data=table"]
