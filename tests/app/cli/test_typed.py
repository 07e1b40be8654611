"""Printed options can be typed in a shell and keep their values."""

from __future__ import annotations

import re
import shlex
from pathlib import Path
from typing import Any

import pytest
from hydra import compose, initialize_config_dir
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import OmegaConf, open_dict

from nnode.app.cli.saved import plain_config
from nnode.app.cli.typed import changes, group_defaults, literal, shell_override
from nnode.app.discover import _commands
from nnode.config import register
from tests.app.conftest import CONF, composed


@pytest.fixture(autouse=True, scope="module")
def _schemas() -> None:
    register()


@pytest.mark.parametrize(
    "value",
    [
        "runs/a/last.pt",
        "/tmp/a folder/it's/last.pt",
        "a,b=[c]/x.pt",
        "ends with \\",
        "a\\'b",
        "",
        "null",
        "True",
        "1e5",
        "-3",
        "1_000",
        "inf",
        "C:/x",
        "größe",
        None,
        True,
        False,
        3,
        -2,
        0.25,
        1e-7,
        3e20,
        [],
        ["e_0", 2, None],
        {},
        {"vehicle": "the id", "a:b, c": [1.5, "x,y"]},
    ],
)
def test_printed_value_is_read_unchanged(value: Any) -> None:
    (typed,) = shlex.split(shell_override("data.option", value))
    (override,) = OverridesParser.create().parse_overrides([typed])
    config = OmegaConf.create({"option": plain(override.value())})
    result = OmegaConf.to_container(config)["option"]  # type: ignore[index, call-overload]
    assert result == value
    assert type(result) is type(value)


def plain(value: Any) -> Any:
    """A value of Hydra without its quotes."""
    if isinstance(value, list):
        return [plain(item) for item in value]
    if isinstance(value, dict):
        return {key: plain(item) for key, item in value.items()}
    return getattr(value, "text", value)


def test_defaults_ignore_a_previous_job() -> None:
    HydraConfig.instance().set_config(composed("train", "model=n4", "data=table"))
    try:
        assert group_defaults("data", "table")["name"] == "table"
        assert "groups" not in plain_config(OmegaConf.create({"data": {}}))
    finally:
        HydraConfig.instance().cfg = None


def test_plain_text_has_no_quotes() -> None:
    assert literal("runs/a_1/x.pt") == "runs/a_1/x.pt"
    assert shell_override("data.path", "runs/x.pt") == "data.path=runs/x.pt"


def test_changes_from_defaults() -> None:
    defaults = {"path": "???", "walls": {"*": [0, 4]}, "split": {"seed": 0, "gap": 5.0}, "dt": 0.2}
    values = {"path": "a.xml", "walls": {"b": [0, 3]}, "split": {"seed": 1, "gap": 5.0}, "dt": 0.2}
    assert changes("data", values, defaults) == [
        "data.path=a.xml",
        "'data.walls={b: [0, 3]}'",
        "data.split.seed=1",
    ]
    assert changes("data", defaults, defaults) == []


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("model", "data"),
    [
        (
            "lin",
            "data=sumo data.path='a folder/fcd.xml.gz' data.window=null data.lane=[e_0,e_1] "
            "data.kinds={DEFAULT_VEHTYPE: car}",
        ),
        ("lin", "data=highd data.path=01_tracks.csv data.lane=2 data.split.heldout=0.3"),
        (
            "lin",
            "data=vehicles data.path=cars.csv data.position_unit=ft "
            "data.columns={vehicle: Vehicle_ID, time: t}",
        ),
        ("sf", "data=table data.path=walk.csv data.domain=crowd data.walls=w.csv"),
        ("sf", "data=jupedsim data.path=run.sqlite data.t_seq=2 data.velocity=central"),
        (
            "sf",
            r"data=pedpy data.path='it\'s.txt' data.geometry=area.wkt data.unit=cm "
            "data.frame_rate=16",
        ),
    ],
)
def test_printed_training_reads_the_data_of_the_diagnosis(
    model: str, data: str, tmp_path: Path
) -> None:
    with initialize_config_dir(str(CONF), version_base="1.3"):
        config = compose(
            "discover", [f"model={model}", *re.split(r" (?=data)", data)], return_hydra_config=True
        )
        HydraConfig.instance().set_config(config)
        with open_dict(config):
            del config["hydra"]  # as Hydra does before a job
        try:
            plain_options = plain_config(config)
            command = _commands({**plain_options, "model": {"name": model}}, tmp_path)[-1]
        finally:
            HydraConfig.instance().cfg = None
    program, name, *overrides = shlex.split(command)
    assert [program, name] == ["nnode", "train"]
    composed_data = composed("train", *overrides).data
    assert (
        OmegaConf.to_container(composed_data, resolve=True, enum_to_str=True)
        == plain_options["data"]
    )


def test_printed_training_copies_the_user_s_model(tmp_path: Path) -> None:
    data = {**group_defaults("data", "table"), "path": "drive.csv", "domain": "traffic"}
    config = {"model": {"name": "mine"}, "data": data, "groups": {"data": "table"}}
    *_, copy, train = _commands(config, tmp_path)
    assert copy == f"mkdir -p conf/model && cp {tmp_path}/model.yaml conf/model/mine.yaml"
    assert train.startswith("nnode train --config-dir conf model=mine data=table data.")


def test_defaults_come_from_the_schema() -> None:
    defaults = group_defaults("data", "table")
    values = {**defaults, "path": "drive.csv", "domain": "traffic"}
    assert changes("data", values, defaults) == ["data.domain=traffic", "data.path=drive.csv"]
