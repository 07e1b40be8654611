"""Options that are printed can be typed, and mean what they meant."""

from __future__ import annotations

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
def test_a_value_is_read_as_it_was(value: Any) -> None:
    (typed,) = shlex.split(shell_override("data.option", value))
    (override,) = OverridesParser.create().parse_overrides([typed])
    config = OmegaConf.create({"option": None})
    with open_dict(config):
        config.option = plain(override.value())
    result = OmegaConf.to_container(config)["option"]  # type: ignore[index, call-overload]
    assert result == value
    assert type(result) is type(value)


def plain(value: Any) -> Any:
    """A value of Hydra's without the quotes that it remembers."""
    if isinstance(value, list):
        return [plain(item) for item in value]
    if isinstance(value, dict):
        return {key: plain(item) for key, item in value.items()}
    return getattr(value, "text", value)


def test_what_a_job_has_left_behind_is_not_taken() -> None:
    HydraConfig.instance().set_config(composed("train", "model=n4", "data=table"))
    try:
        assert group_defaults("data", "table")["name"] == "table"
        assert "groups" not in plain_config(OmegaConf.create({"data": {}}))
    finally:
        HydraConfig.instance().cfg = None


def test_texts_need_no_quotes_where_they_mean_themselves() -> None:
    assert literal("runs/a_1/x.pt") == "runs/a_1/x.pt"
    assert shell_override("data.path", "runs/x.pt") == "data.path=runs/x.pt"


def test_only_what_differs_is_told() -> None:
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
    ("model", "given"),
    [
        (
            "lin",
            [
                "data=sumo",
                "data.path='a folder/fcd.xml.gz'",
                "data.window=null",
                "data.lane=[e_0,e_1]",
                "data.kinds={DEFAULT_VEHTYPE: car}",
            ],
        ),
        ("lin", ["data=highd", "data.path=01_tracks.csv", "data.lane=2", "data.split.heldout=0.3"]),
        (
            "lin",
            [
                "data=vehicles",
                "data.path=cars.csv",
                "data.position_unit=ft",
                "data.columns={vehicle: Vehicle_ID, time: t}",
            ],
        ),
        ("sf", ["data=table", "data.path=walk.csv", "data.domain=crowd", "data.walls=w.csv"]),
        ("sf", ["data=jupedsim", "data.path=run.sqlite", "data.t_seq=2", "data.velocity=central"]),
        (
            "sf",
            [
                "data=pedpy",
                r"data.path='it\'s.txt'",
                "data.geometry=area.wkt",
                "data.unit=cm",
                "data.frame_rate=16",
            ],
        ),
    ],
)
def test_the_printed_training_reads_the_data_of_the_diagnosis(
    model: str, given: list[str], tmp_path: Path
) -> None:
    with initialize_config_dir(str(CONF), version_base="1.3"):
        config = compose("discover", [f"model={model}", *given], return_hydra_config=True)
        HydraConfig.instance().set_config(config)
        with open_dict(config):
            del config["hydra"]  # as Hydra does before a job
        try:
            told = plain_config(config)
            command = _commands({**told, "model": {"name": model}}, tmp_path)[-1]
        finally:
            HydraConfig.instance().cfg = None
    program, name, *overrides = shlex.split(command)
    assert [program, name] == ["nnode", "train"]
    read = composed("train", *overrides)
    assert OmegaConf.to_container(read.data, resolve=True, enum_to_str=True) == told["data"]


def test_the_printed_training_finds_the_model_in_a_folder_of_the_user_s(tmp_path: Path) -> None:
    data = {**group_defaults("data", "table"), "path": "drive.csv", "domain": "traffic"}
    config = {"model": {"name": "mine"}, "data": data, "groups": {"data": "table"}}
    *_, copy, train = _commands(config, tmp_path)
    assert copy == f"mkdir -p conf/model && cp {tmp_path}/model.yaml conf/model/mine.yaml"
    assert train.startswith("nnode train --config-dir conf model=mine data=table data.")


def test_without_a_configuration_the_schema_tells_the_defaults() -> None:
    defaults = group_defaults("data", "table")
    values = {**defaults, "path": "drive.csv", "domain": "traffic"}
    assert changes("data", values, defaults) == ["data.domain=traffic", "data.path=drive.csv"]
