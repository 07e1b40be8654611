"""The tables of the crowd study, from synthetic results whose numbers are known."""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd
import pytest

from nnode.pages.page import Block
from nnode.pages.replay import ReplayBlock
from studies.crowd import printed, tasks
from studies.crowd import study as crowd
from studies.options import CrowdStudyOptions, checked
from tests.studies.crowd import invented
from tests.studies.crowd.corridor import DT

ALL = slice(None)


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


#: A, k and kappa.
NAMES = list(printed.parameters)
FIRST = invented.FORCE[1]


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("table", "rows", "columns", "values"),
    [
        # all sequences have the same cost, so that intervals have no width
        ("crowd_costs", "SF", ["printed (m²)", "here (m²)"], [printed.costs["sf"], 2.0 / DT]),
        *(
            ("crowd_costs", label, ["here (m² s)", "from", "to"], [cost] * 3)
            for label, cost in (("SF", 2.0), ("NN", 1.0), ("NN, walls alone", 1.9))
        ),
        ("crowd_parameters", "here, 1 s", NAMES, FIRST),
        # 95 % of 20 refits from 0.5 to 1.5 times the estimate
        ("crowd_parameters", "here, 1 s", [f"{n} from" for n in NAMES], 0.525 * np.array(FIRST)),
        ("crowd_parameters", "here, 1 s", [f"{n} to" for n in NAMES], 1.475 * np.array(FIRST)),
        ("crowd_parameters", "printed, 1 s", NAMES, list(printed.parameters.values())),
        ("crowd_horizons", ("held out", "SF"), ["1 s", "2 s"], 2.0),
        ("crowd_horizons", ("training", "NN"), ["1 s", "2 s"], 1.0),
        # worse in one block of four
        ("crowd_blocks", ("1 s", "2"), "NN", invented.NN_THERE),
        ("crowd_blocks", ("2 s", "2"), "NN", invented.NN_THERE),
        ("crowd_blocks", ("2 s", "1"), ["NN", "people"], [1.0, 12]),
        ("crowd_heldout_runs", ("2 s", "run-b"), ["NN", "people"], [3.0, 6]),
        ("crowd_data", ALL, "sequences", [24, 2, 24, 2]),
        ("crowd_data", ALL, "left out as faulty", 3),
        ("crowd_restarts", "SF", "J (m² s)", [2.0, 2.2]),
        ("crowd_restarts", ("NN", 0), "likeness, sum", 1.0),
        ("crowd_restarts", ("NN, walls alone", 0), "size, pair", 0.0),
        # the start after the random ones is the best network of the walls
        ("crowd_restarts", ("NN", 2), "size, pair", 0.0),
        ("parameters", ("sf", "all", 1.0, 0), "value", FIRST),
        ("parameters", ("sf", "all", 2.0, 0), "value", invented.FORCE[2]),
    ],
)
def test_cells(
    tables: dict[str, pd.DataFrame], table: str, rows: Any, columns: Any, values: Any
) -> None:
    cells = np.asarray(tables[table].loc[rows, columns], float)
    np.testing.assert_allclose(cells, values, rtol=1e-6)


def test_player_shows_the_longest_sequences(blocks: list[Block]) -> None:
    (block,) = (b for b in blocks if isinstance(b, ReplayBlock))
    scenes = list(block.scenes)
    assert (block.total, len(scenes)) == (24, 8)
    for scene in scenes:
        assert list(scene.simulated) == ["SF", "NN"]
        assert scene.sequence.time[-1] - scene.sequence.time[0] == pytest.approx(2.0)
        for x in scene.simulated.values():
            np.testing.assert_array_equal(x[0], scene.sequence.x[0])
            assert np.isfinite(x).all()


def test_blocks_of_time(tables: dict[str, pd.DataFrame]) -> None:
    # the network is worse in one block of four
    assert tables["crowd_horizons"].loc[("held out", "NN")].between(1.0, 2.0).all()
    table = tables["crowd_blocks"]
    assert len(table) == 8
    # people walk 1 m/s along the corridor and slightly across
    assert table["speed"].to_numpy() == pytest.approx(1.0, abs=0.02)


def test_last_start_is_the_network_of_the_walls(tables: dict[str, pd.DataFrame]) -> None:
    table = tables["crowd_restarts"].loc["NN", "size, pair"]
    assert list(table.index) == [0, 1, 2]
    assert table[1] > 0.0
    parameters = tables["parameters"]["value"]
    for horizon, start in ((1.0, 2), (2.0, 3)):
        for scope in ("all", "fold-0"):
            continued = parameters.loc[("nn", scope, horizon, start)]
            assert list(continued) == list(parameters.loc[("wall", scope, horizon, 0)])
