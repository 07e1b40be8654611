"""The tables of the traffic study, from synthetic results whose numbers are known."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from nnode.data.store import Store, write_store
from nnode.pages.page import Block, Provenance
from nnode.pages.replay import ReplayBlock
from studies.options import TrafficStudyOptions
from studies.traffic import printed, tasks
from studies.traffic import study as traffic
from tests.studies.traffic import invented

FAULT = {"kind": "jump", "sequence": "1-1_1/002", "agents": [1], "time": 200.4}
OPTIONS = TrafficStudyOptions(workers=1, restarts=8, bootstrap=2, descent_steps=5)


def store(options: Any, policy: str, folder: Path) -> Store:
    """Three platoons in each recording, one of them faulty."""
    manifest = {
        "recordings": {name: {"kept": 3 if policy == "keep" else 2} for name in printed.recordings},
        "faults": [FAULT],
        "files": {"a": {"name": "a.mat", "sha256": "12ab"}},
    }
    sequences = [s for name in printed.recordings for s in invented.platoons(name)]
    return write_store(folder / "data" / policy, sequences, manifest)


@pytest.fixture(scope="module")
def blocks(tmp_path_factory: pytest.TempPathFactory) -> list[Block]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(traffic, "_prepared", store)
        for name in ("fit", "cross_validate", "descend", "scan"):
            patch.setattr(tasks, name, getattr(invented, name))
        return traffic.run(OPTIONS, tmp_path_factory.mktemp("study"))


MEAN = pd.DataFrame(printed.costs).mean()
#: Mean difference from the printed cost: -1 in nine recordings, see invented.ABOVE for the tenth.
DIFFERENCE = pd.Series({"lin": -1.0, "n10": -1.0, "log": -0.7, "n2": -0.96, "n4": -0.6})
ALL = slice(None)


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("table", "rows", "columns", "values"),
    [
        ("averages", list(printed.average_costs), "printed", list(printed.average_costs.values())),
        ("averages", list(DIFFERENCE.index), "here", (MEAN + DIFFERENCE)[DIFFERENCE.index]),
        # half of the cost, without a wider search
        (
            "averages",
            list(DIFFERENCE.index),
            "faults dropped",
            (MEAN + DIFFERENCE.replace(-0.96, -0.8))[DIFFERENCE.index] / 2,
        ),
        ("averages", list(DIFFERENCE.index), "paper's optimiser", MEAN[DIFFERENCE.index] + 2),
        ("averages", ["n4", "lin"], "weights in box", [MEAN["n4"] + 5, np.nan]),
        # 95 % of 101 values in a range of 4 m; one length is at its bound
        (
            "table_1",
            [("lin", part) for part in ("here", "95 % low", "95 % high")],
            ["1-1_1", invented.LEAST_IN],
            [[5.0, 2.0], [3.1, 0.1], [6.9, 3.9]],
        ),
        ("table_1", ("log", "difference"), "1-1_1", 5.0 - printed.lengths["log"][0]),
        # the wider search is better
        ("table_2", "n2", "3-1_1", 23.5),
        ("table_2_lower", ("n4", "5-1_2"), ["printed", "here"], [72.02, 75.02]),
        ("table_2_lower", ("n4", "5-1_2"), "best tenth of starts", 76.02),
        ("table_2_lower", ("log", "2-1_1"), ["printed", "here", "grid"], [113.69, 115.69, 114.69]),
        # the length of the grid next to the printed 9.20 m is 9.25 m, 7.25 m above the lowest
        ("table_2_lower", ("log", "2-1_1"), "grid, printed L", 121.94),
        ("leader_speeds", "lin", ALL, 90.0),
        ("leader_speeds", ["n2", "n4", "n10", "log"], ALL, 72.0),
        ("heldout", ("keep", "lin"), ["mean", "sequences"], [1.0, 30]),
        ("heldout", ("keep", "n2-box"), "median", 1.5),
        ("significance", "lin − log", ["difference", "first is better (%)"], [-1.0, 100.0]),
        ("significance", "n2-box − n4-box", "p, Holm", 1.0),
        ("optimizers", "lin", ["at the start", "residual, ADADELTA"], [MEAN["lin"] + 10, 0.1]),
        ("steps", ALL, "0.2 s", 20.0),
        ("steps", ALL, "0.001 s", 0.1),
        ("recordings", ALL, ["sequences", "without faults", "vehicles"], [[3, 2, 9]] * 10),
        ("recordings", ALL, "longest (s)", 1.0),
    ],
)
def test_cells(
    tables: dict[str, pd.DataFrame], table: str, rows: Any, columns: Any, values: Any
) -> None:
    cells = np.asarray(tables[table].loc[rows, columns], float)
    np.testing.assert_allclose(cells, values, rtol=1e-6)


def test_intervals_and_differences(tables: dict[str, pd.DataFrame]) -> None:
    table = tables["averages"]
    assert (table["95 % low"] < table["here"]).all()
    assert (table["here"] < table["95 % high"]).all()
    assert list(tables["table_2_lower"].index) == [("n4", "5-1_2"), ("log", "2-1_1")]
    assert tables["significance"].loc["lin − log", "p, Holm"] < 0.05
    assert list(tables["steps"].columns)[:2] == ["0.2 s", "0.1 s"]


def test_player_shows_every_recording(blocks: list[Block]) -> None:
    (block,) = (b for b in blocks if isinstance(b, ReplayBlock))
    recordings = [scene.sequence.recording for scene in block.scenes]
    assert list(dict.fromkeys(recordings)) == list(printed.recordings)
    scene = next(s for s in block.scenes if s.sequence.recording != invented.LEAST_IN)
    time = scene.sequence.time - scene.sequence.time[0]
    for model, speed in (("lin", invented.V0_LIN), ("n2", invented.V0)):
        lead = scene.simulated[model][:, -1, 0]
        np.testing.assert_allclose(lead - lead[0], speed * time, atol=1e-6)


def test_costs_of_faulty_sequences(tables: dict[str, pd.DataFrame]) -> None:
    # the faulty sequence has half of the cost of its recording
    assert list(tables["faulty"].loc["n4"]) == pytest.approx([1, 30, 5.0, 2.0], rel=0.02)
    table = tables["dominating_sequences"]
    columns = ["sequence", "faults", "start (s)", "vehicles", "share lin (%)"]
    assert list(table.iloc[0][columns]) == ["1-1_1/002", "jump", 200.0, 3, pytest.approx(50.0)]
    assert set(table["faults"].iloc[1:]) == {"none found"}


def test_sources_and_parameters_are_listed(
    blocks: list[Block], tables: dict[str, pd.DataFrame]
) -> None:
    assert Provenance({"SHA-256 of a.mat": "12ab"}) in blocks
    rows = tables["parameters"]
    lin = rows.query("model == 'lin' and parameter == 'L' and faults == 'drop'")
    assert set(lin["recording"]) == set(printed.recordings)
    assert set(rows["optimizer"]) == {"bfgs", "adadelta"}
