"""The crowd study's page says what the results say: all numbers here are known by hand."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pandas as pd
import pytest

from nnode.calibrate.resampling import Paired
from nnode.pages.page import Block, FigureBlock, TableBlock, Text, write_page
from nnode.pages.replay import ReplayBlock
from studies.crowd import conventions, tasks
from studies.crowd import page as crowd_page
from studies.crowd import page_forces as crowd_page_forces
from studies.crowd import study as crowd
from studies.crowd.printed import COSTS, PARAMETERS
from studies.options import CrowdStudyOptions
from tests.studies.crowd import invented
from tests.studies.crowd.corridor import DT


@pytest.fixture(scope="module")
def blocks(tmp_path_factory: pytest.TempPathFactory) -> list[Block]:
    options = CrowdStudyOptions(workers=1, restarts=2, horizons=[2.0, 1.0], bootstrap=20)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(crowd, "prepare_horizon", invented.store)
        patch.setattr(conventions, "recording_file", lambda *_: "a.txt")
        patch.setattr(conventions, "scan", invented.scan)
        patch.setattr(conventions, "network", invented.network)
        for name in ("fit", "resample", "baselines", "transfer"):
            patch.setattr(tasks, name, getattr(invented, name))
        return crowd.run(options, tmp_path_factory.mktemp("study"))


@pytest.fixture(scope="module")
def tables(blocks: list[Block]) -> dict[str, pd.DataFrame]:
    return {b.name: b.frame for b in blocks if isinstance(b, TableBlock)}


@pytest.fixture(scope="module")
def words(blocks: list[Block]) -> str:
    return "\n".join(b.markdown for b in blocks if isinstance(b, Text))


def test_costs_are_in_both_units(tables: dict[str, pd.DataFrame], words: str) -> None:
    table = tables["crowd_costs"]
    assert table.loc["SF", "printed (m²)"] == COSTS["sf"]
    for label, cost in (("SF", 2.0), ("NN", 1.0), ("NN, walls alone", 1.9)):
        assert table.loc[label, "here (m² s)"] == pytest.approx(cost)
        assert table.loc[label, "here (m²)"] == pytest.approx(cost / DT)
        # all sequences cost the same, whatever is resampled
        assert table.loc[label, "from"] == pytest.approx(cost)
        assert table.loc[label, "to"] == pytest.approx(cost)
    assert "J_SF = 50.000 and J_NN = 25.000 m²" in words
    assert "the relaxation without any interaction has 100.000." in words
    assert "Both printed costs lie above" not in words
    assert len(tables["crowd_conventions"]) == 30
    assert len(tables["crowd_conventions_networks"]) == 6


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


def test_parameters_and_which_printed_ones_are_inside(
    tables: dict[str, pd.DataFrame], words: str
) -> None:
    row = tables["crowd_parameters"].loc["here, 1 s"]
    for name, value in zip(("A", "k", "κ"), invented.FORCE[1], strict=True):
        assert row[name] == value
        # of 20 refits from half of it to one and a half
        assert row[f"{name} from"] == pytest.approx(0.525 * value)
        assert row[f"{name} to"] == pytest.approx(1.475 * value)
    assert list(tables["crowd_parameters"].loc["printed, 1 s", ["A", "k", "κ"]]) == list(
        PARAMETERS.values()
    )
    assert "the printed 0.0044 is outside the interval" in words
    assert "the printed 34.9539 is inside the interval" in words
    assert "those of 2 s: A +10%, k -10%, kappa +20%." in words


def test_held_out_costs_and_their_differences(tables: dict[str, pd.DataFrame], words: str) -> None:
    table = tables["crowd_horizons"]
    for horizon in ("1 s", "2 s"):
        assert table.loc[("SF", "held out"), horizon] == pytest.approx(2.0)
        assert table.loc[("NN", "training"), horizon] == pytest.approx(1.0)
        # worse in one block of four
        assert 1.0 < table.loc[("NN", "held out"), horizon] < 2.0
        assert f"Held out, {horizon}: NN is below SF" in words
        assert f"{horizon}: SF is below relaxation alone (difference -2.0000 m² s" in words
    assert (
        "is below SF at 1 s, 2 s. Forces between people lower NN's held-out cost at 1 s, 2 s."
        in words
    )


def test_the_block_in_which_a_model_fails(tables: dict[str, pd.DataFrame], words: str) -> None:
    table = tables["crowd_blocks"]
    assert len(table) == 8
    for horizon in ("1 s", "2 s"):
        assert table.loc[(horizon, "2"), "NN"] == invented.NN_THERE
        assert table.loc[(horizon, "1"), "NN"] == 1.0
    assert (table["people"] == 12).all()
    # everyone walks 1 m/s along the corridor and a little across
    assert table["speed"].to_numpy() == pytest.approx(1.0, abs=0.02)
    # as many people as in the others: nothing is said of emptier times
    assert "NN is above SF in block 2 at 1 s (12 people), block 2 at 2 s (12 people)." in words
    assert "fewer people" not in words


def test_other_runs_are_counted(tables: dict[str, pd.DataFrame], words: str) -> None:
    assert tables["crowd_heldout_runs"].loc[("2 s", "run-b"), "NN"] == 3.0
    for horizon in ("1 s", "2 s"):
        assert (
            f"{horizon}: of 2 runs, NN is below SF in 1, SF below no interaction in 2, NN below "
            "no interaction in 2." in words
        )
    data = tables["crowd_data"]
    assert list(data["sequences"]) == [24, 2, 24, 2]
    assert (data["left out as faulty"] == 3).all()


def test_starts_are_set_side_by_side(tables: dict[str, pd.DataFrame], words: str) -> None:
    table = tables["crowd_restarts"]
    assert list(table.loc["SF", "J (m² s)"]) == pytest.approx([2.0, 2.2])
    assert table.loc[("NN", 0), "likeness, sum"] == pytest.approx(1.0)
    assert table.loc[("NN, walls alone", 0), "size, pair"] == 0.0
    assert "SF: 1 of 2 starts end within 5% of the least cost; all find the same A, k" in words
    assert "NN: 1 of 2 starts end within 5% of the least cost, 1.0000 m² s (worst: 1.1000)" in words
    assert "Only one start of NN ends near its least cost" in words
    assert "The mean speed is 1.0" in words


def test_the_page_can_be_written(blocks: list[Block], tmp_path: Path) -> None:
    few = [b for b in blocks if not isinstance(b, FigureBlock)]
    write_page(few, tmp_path, title=crowd.TITLE, subtitle=crowd.SUBTITLE)
    assert "SHA-256 of a.txt: 34cd" in (tmp_path / "study.md").read_text(encoding="utf-8")
    rows = pd.read_csv(tmp_path / "parameters.csv")
    one = rows[(rows["model"] == "sf") & (rows["trained on"] == "all") & (rows["start"] == 0)]
    assert list(one["value"]) == pytest.approx(invented.FORCE[1] + invented.FORCE[2])


@pytest.mark.parametrize(
    ("near", "likeness", "said"),
    [
        (3, {"pair": 0.95, "wall": 0.92, "sum": 0.99}, "agree on both forces"),
        (3, {"pair": 0.5, "wall": 0.4, "sum": 0.9}, "agree far better on the sum"),
        (3, {"pair": 0.5, "wall": 0.95, "sum": 0.97}, "agree neither on the parts nor"),
        (1, {}, "nothing can be said"),
    ],
)
def test_words_on_agreement_follow_from_likeness(
    near: int, likeness: dict[str, float], said: str
) -> None:
    starts = SimpleNamespace(near=lambda: near, least_likeness=likeness.get)
    assert said in crowd_page_forces._agreement(cast(Any, starts))


def test_parameters_that_part_are_told() -> None:
    fits = [SimpleNamespace(row=row) for row in ([1.0, 2.0, 4.0], [1.5, 2.0, 3.0])]
    starts = SimpleNamespace(fits=fits, near=lambda: 2)
    text = crowd_page_forces._spread(cast(Any, starts))
    assert text.endswith("relative differences of their parameters are A 0.5, k 0, kappa 0.25.")


@pytest.mark.parametrize(
    ("wall_to_sf", "nn_to_wall", "said"),
    [
        (-1.0, {1.0: 0.0, 2.0: 0.0}, "no interaction but a correction of the relaxation"),
        (1.0, {1.0: 0.0, 2.0: 1.0}, "nowhere below SF. Forces between people raise"),
        (-1.0, {1.0: -1.0, 2.0: 1.0}, "lower NN's held-out cost at 1 s and raise it at 2 s."),
    ],
)
def test_words_on_pairs_follow_from_both_comparisons(
    wall_to_sf: float, nn_to_wall: dict[float, float], said: str
) -> None:
    def compare(first: str, second: str, horizon: float) -> Paired:
        away = nn_to_wall[horizon] if first == "nn" else wall_to_sf
        return Paired(away, away - 0.5, away + 0.5, p=0.5, better=0.5)

    study = SimpleNamespace(horizons=[1.0, 2.0], compare=compare)
    assert said in crowd_page._pairs_matter(cast(Any, study))


def test_bold_marks_the_least_calibrated_model() -> None:
    table = pd.DataFrame(
        {"SF": [1.0, 3.0], "NN": [2.0, 1.0], "NN, walls alone": [2.0, 1.0], "n": 0}
    )
    bold = crowd_page._least(table)
    assert np.array_equal(
        bold[["SF", "NN", "NN, walls alone"]].to_numpy(),
        [[True, False, False], [False, True, True]],
    )
    assert not bold["n"].any()
