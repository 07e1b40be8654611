"""The tables of the crowd study, from invented results whose numbers are known by hand."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest

from nnode.pages.page import Block, TableBlock
from nnode.pages.replay import ReplayBlock
from studies.crowd import printed, tasks
from studies.crowd import study as crowd
from studies.options import CrowdStudyOptions, checked
from tests.studies.crowd import invented
from tests.studies.crowd.corridor import DT


@pytest.fixture(scope="module")
def blocks(tmp_path_factory: pytest.TempPathFactory) -> list[Block]:
    options = CrowdStudyOptions(
        workers=1, restarts=invented.RESTARTS, horizons=[2.0, 1.0], bootstrap=20
    )
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(crowd, "prepared", invented.store)
        for name in ("fit", "resample", "baselines", "transfer"):
            patch.setattr(tasks, name, getattr(invented, name))
        return crowd.run(checked(options), tmp_path_factory.mktemp("study"))


@pytest.fixture(scope="module")
def tables(blocks: list[Block]) -> dict[str, pd.DataFrame]:
    return {b.name: b.full for b in blocks if isinstance(b, TableBlock) and b.full is not None}


@pytest.mark.thorough
def test_costs_are_in_both_units(tables: dict[str, pd.DataFrame]) -> None:
    table = tables["crowd_costs"]
    assert table.loc["SF", "printed (m²)"] == printed.costs["sf"]
    for label, cost in (("SF", 2.0), ("NN", 1.0), ("NN, walls alone", 1.9)):
        assert table.loc[label, "here (m² s)"] == pytest.approx(cost)
        assert table.loc[label, "here (m²)"] == pytest.approx(cost / DT)
        # all sequences cost the same, whatever is resampled
        assert table.loc[label, "from"] == pytest.approx(cost)
        assert table.loc[label, "to"] == pytest.approx(cost)


def test_the_player_shows_the_longest_sequences(blocks: list[Block]) -> None:
    (block,) = (b for b in blocks if isinstance(b, ReplayBlock))
    scenes = list(block.scenes)
    assert block.total == 24
    assert len(scenes) == 8
    for scene in scenes:
        assert list(scene.simulated) == ["SF", "NN"]
        assert scene.sequence.time[-1] - scene.sequence.time[0] == pytest.approx(2.0)
        for x in scene.simulated.values():
            np.testing.assert_array_equal(x[0], scene.sequence.x[0])
            assert np.isfinite(x).all()


def test_parameters_with_their_intervals(tables: dict[str, pd.DataFrame]) -> None:
    row = tables["crowd_parameters"].loc["here, 1 s"]
    for name, value in zip(("A", "k", "kappa"), invented.FORCE[1], strict=True):
        assert row[name] == value
        # of 20 refits from half of it to one and a half
        assert row[f"{name} from"] == pytest.approx(0.525 * value)
        assert row[f"{name} to"] == pytest.approx(1.475 * value)
    assert list(tables["crowd_parameters"].loc["printed, 1 s", ["A", "k", "kappa"]]) == list(
        printed.parameters.values()
    )


def test_held_out_costs_and_their_differences(tables: dict[str, pd.DataFrame]) -> None:
    table = tables["crowd_horizons"]
    for horizon in ("1 s", "2 s"):
        assert table.loc[("held out", "SF"), horizon] == pytest.approx(2.0)
        assert table.loc[("training", "NN"), horizon] == pytest.approx(1.0)
        # worse in one block of four
        assert 1.0 < table.loc[("held out", "NN"), horizon] < 2.0


def test_the_block_in_which_a_model_fails(tables: dict[str, pd.DataFrame]) -> None:
    table = tables["crowd_blocks"]
    assert len(table) == 8
    for horizon in ("1 s", "2 s"):
        assert table.loc[(horizon, "2"), "NN"] == invented.NN_THERE
        assert table.loc[(horizon, "1"), "NN"] == 1.0
    assert (table["people"] == 12).all()
    # everyone walks 1 m/s along the corridor and a little across
    assert table["speed"].to_numpy() == pytest.approx(1.0, abs=0.02)


def test_other_runs_are_counted(tables: dict[str, pd.DataFrame]) -> None:
    assert tables["crowd_heldout_runs"].loc[("2 s", "run-b"), "NN"] == 3.0
    data = tables["crowd_data"]
    assert list(data["sequences"]) == [24, 2, 24, 2]
    assert (data["left out as faulty"] == 3).all()


def test_starts_are_set_side_by_side(tables: dict[str, pd.DataFrame]) -> None:
    table = tables["crowd_restarts"]
    assert list(table.loc["SF", "J (m² s)"]) == pytest.approx([2.0, 2.2])
    assert table.loc[("NN", 0), "likeness, sum"] == pytest.approx(1.0)
    assert table.loc[("NN, walls alone", 0), "size, pair"] == 0.0
    # the start after the random ones is the best network of the walls alone
    assert list(table.loc["NN"].index) == [0, 1, 2]
    assert table.loc[("NN", 2), "size, pair"] == 0.0
    assert table.loc[("NN", 1), "size, pair"] > 0.0
    parameters = tables["parameters"]["value"]
    for horizon, start in ((1.0, 2), (2.0, 3)):
        for scope in ("all", "fold-0"):
            continued = parameters.loc[("nn", scope, horizon, start)]
            assert list(continued) == list(parameters.loc[("wall", scope, horizon, 0)])


def test_all_parameters_are_named(tables: dict[str, pd.DataFrame]) -> None:
    assert list(tables["parameters"].loc[("sf", "all", 1.0, 0), "value"]) == invented.FORCE[1]
    assert list(tables["parameters"].loc[("sf", "all", 2.0, 0), "value"]) == invented.FORCE[2]
