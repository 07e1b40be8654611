"""``data.prepared=FOLDER``: the options of the data come from the folder."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pandas as pd
import pytest

import nnode
from nnode.app.cli.prepared import prepared_group
from nnode.app.cli.typed import written
from nnode.data.prepare import FORMATS, prepare
from nnode.data.readers.esimas import EsimasOptions
from nnode.data.readers.jupedsim import WalkwayOptions
from nnode.data.readers.table import TableOptions
from nnode.errors import DataError
from tests.app.conftest import Script, read_json
from tests.diagnosis.recorded import lane


def numbered(path: Path) -> pd.DataFrame:
    table = pd.read_csv(path)
    table["agent"] = table["agent"].str.rpartition("-")[2]
    table["time"] -= table.groupby("sequence")["time"].transform("min")
    return table


@pytest.fixture(scope="module")
def table(script: Script, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A prepared table whose identifiers and times start from 0 in every sequence."""
    folder = tmp_path_factory.mktemp("table")
    path = folder / "lane.csv"
    numbered(lane(path, sequences=6, seconds=4.0, cars=3)).to_csv(path, index=False)
    done = script(
        "prepare_data",
        "data=table",
        f"data.path={path}",
        "data.domain=traffic",
        "data.faults=keep",
        folder=folder / "out",
    )
    (note,) = [line for line in done.stdout.splitlines() if "data.agents decides by hand" in line]
    assert "lane: identifiers belong to their sequence" in note
    assert f"(train with data.prepared={folder / 'out'})" in done.stdout
    path.unlink()
    return folder / "out"


@pytest.mark.thorough
def test_training_needs_only_the_folder(script: Script, table: Path, tmp_path: Path) -> None:
    arguments = ["trainer.max_epochs=1", f"hydra.run.dir={tmp_path}"]
    script("train", f"data.prepared={table}", *arguments)
    assert not (tmp_path / "data").exists()
    assert read_json(tmp_path / "result.json")["summary"]["data"] == "table"
    # the checkpoint contains the data's folder
    best = tmp_path / "checkpoints" / "best.pt"
    script("evaluate", f"checkpoint={best}", folder=tmp_path)


def test_fit_reads_a_table_with_repeated_identifiers(tmp_path: Path) -> None:
    table = numbered(lane(tmp_path / "lane.csv", sequences=6, seconds=4.0, cars=3))
    continued = table.assign(time=table.time + 5.0 * table.sequence)
    for data in (table, continued):
        assert nnode.fit(data, "traffic", epochs=2).cost_heldout > 0


@pytest.mark.thorough
def test_diagnosis_needs_only_the_folder(script: Script, table: Path, tmp_path: Path) -> None:
    options = ["discover.page=false", "discover.compare=[]", f"hydra.run.dir={tmp_path}"]
    script("discover", f"data.prepared={table}", *options)
    assert (tmp_path / "report.json").is_file()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (
            ["data=table", "data.faults=drop"],
            "was prepared with other options: data.faults=keep then, drop now. Leave out "
            "data.faults to take the folder as it is, or data.prepared to prepare the data anew",
        ),
        (["data=esimas"], "holds data=table, chosen is data=esimas; leave out data=esimas to take"),
    ],
)
def test_options_that_contradict_the_folder_are_refused(
    script: Script, table: Path, tmp_path: Path, options: list[str], message: str
) -> None:
    done = script("train", *options, f"data.prepared={table}", folder=tmp_path, status=2)
    assert message in done.stderr


def test_group_comes_from_the_folder(raw: Path, table: Path, tmp_path: Path) -> None:
    selected = [f"data.prepared={tmp_path}"]
    options = EsimasOptions(name="demo_traffic", recording="demo", source=str(raw))
    prepare(options, tmp_path)
    assert prepared_group(selected) == ["data=demo_traffic"]
    assert prepared_group([*selected, "data=esimas"]) == []
    assert prepared_group(["data.prepared=null"]) == []
    options.name = "mine"  # not the name of a group of this reader
    prepare(options, tmp_path)
    assert prepared_group(selected) == ["data=esimas"]
    options.name = "table"
    prepare(options, tmp_path)
    assert prepared_group(selected) == ["data=esimas"]
    assert prepared_group([f"data.prepared={table}"]) == ["data=table"]
    with pytest.raises(DataError, match="holds no prepared data"):
        prepared_group([f"data.prepared={raw}"])


def test_every_reader_has_a_group() -> None:
    for reader in FORMATS:
        assert written("data", str(reader().name))[0] is reader
    assert {TableOptions, WalkwayOptions} <= set(FORMATS)


@pytest.mark.parametrize("name", ["../" * 12 + "{}/evil", "{}/evil", "../data/table"])
def test_manifest_cannot_name_a_file_outside_the_configuration(
    table: Path, tmp_path: Path, name: str
) -> None:
    store = shutil.copytree(table, tmp_path / "store")
    (store / "evil.yaml").write_text("defaults:\n- table_schema\ndomain: traffic\npath: x\n")
    content = read_json(store / "manifest.json")
    content["manifest"]["options"]["name"] = name.format(str(store).lstrip("/"))
    (store / "manifest.json").write_text(json.dumps(content))
    assert prepared_group([f"data.prepared={store}"]) == ["data=table"]
