"""Conventions of the crowd study: cut by hand, by the reader, and what the page says of them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from nnode.data.options import JuelichOptions, Velocity
from nnode.data.prepare import prepare
from nnode.data.sequence import collate
from nnode.pages.page import TableBlock, Text
from studies.crowd import conventions
from studies.crowd.conventions import EVERY, Convention, Tracks, key
from studies.crowd.data import RECORDING, WALLS
from studies.crowd.fit import calibrate, new_system, row_of
from studies.crowd.page_conventions import conventions as section
from studies.crowd.page_conventions import network_key, to_calibrate
from studies.crowd.printed import COSTS
from studies.crowd.results import Crowd
from studies.options import CrowdStudyOptions

RATE = 25.0


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> str:
    """Two people in 56 frames: one speeds up to the right, one walks to the left from frame 2 on
    and leaves after frame 53."""
    lines = ["# framerate: 25 fps", "# id frame x/cm y/cm z/cm"]
    for k in range(56):
        lines.append(f"1 {k} {0.2 * k * k - 300} 100 170")
        if 2 <= k <= 53:
            lines.append(f"2 {k} {200 - 4 * k} {300 + k % 3} 180")
    path = tmp_path_factory.mktemp("raw") / f"{RECORDING}.txt"
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return str(path)


@pytest.mark.parametrize(
    ("velocity", "frames"),
    [("forward", 1.0), ("central", 0.0), ("backward", -1.0), ("mean", 24.0), ("none", None)],
)
def test_velocities_of_one_who_speeds_up(
    recording: str, velocity: str, frames: float | None
) -> None:
    # x = 0.002 k² m: a difference over [k, k + n] is 0.002 (2 k + n) m a frame
    batch = Tracks.of(recording).cut(Convention(velocity, 25, "sequence"), 10)
    expected = 0.0 if frames is None else 0.002 * (2 * 10 + frames) * RATE
    assert batch.v[0, 0, 0].tolist() == pytest.approx([expected, 0.0])


def test_who_was_not_there_before_has_a_forward_difference(recording: str) -> None:
    batch = Tracks.of(recording).cut(Convention("backward", 25, "sequence"), 2)
    assert batch.v[0, 0, 1].tolist() == pytest.approx([-0.04 * RATE, -0.02 * RATE])


def test_destinations(recording: str) -> None:
    tracks = Tracks.of(recording)
    found = {
        kind: tracks.cut(Convention("forward", 26, kind), 3).destination[0].numpy()
        for kind in conventions.DESTINATIONS
    }
    right = 0.002 * np.array([28.0, 55.0]) ** 2 - 3
    np.testing.assert_allclose(found["sequence"], [[right[0], 1.0], [0.88, 3.01]])
    np.testing.assert_allclose(found["trajectory"], [[right[1], 1.0], [-0.12, 3.02]])
    # straight on to the outermost places of the recording, each on his side
    np.testing.assert_allclose(found["corridor"], [[right[1], 1.0], [-3.0, 3.0]])


def test_samples_decide_who_is_there_throughout(recording: str) -> None:
    tracks = Tracks.of(recording)
    # from frame 29 on: frames 29 to 53, and 54 with one sample more
    number = {n: tracks.cut(Convention("forward", n), 29).agent.sum().item() for n in (25, 26)}
    assert number == {25: 2, 26: 1}
    assert len(tracks.cut(Convention("forward", 25), 5).names) == 2


@pytest.mark.parametrize("velocity", ["forward", "central", "backward"])
def test_the_studys_own_convention_is_what_the_reader_gives(
    recording: str, tmp_path: Path, velocity: str
) -> None:
    options = JuelichOptions(
        recording=RECORDING,
        walls=WALLS,
        source=str(Path(recording).parent),
        velocity=Velocity(velocity),
    )
    read = collate(prepare(options, tmp_path))
    own = Tracks.of(recording).cut(Convention(velocity), 0)
    for name in ("x", "destination", "walls", "agent"):
        np.testing.assert_allclose(getattr(own, name), getattr(read, name), err_msg=name)
    np.testing.assert_allclose(own.v[0], read.v[0])


def test_a_scan_begins_at_every_frame_that_it_is_told(recording: str) -> None:
    found = conventions.scan(recording, {"velocity": "none"}, cuts=3, seed=0)
    assert found["offsets"] == [0, 8, 16]
    assert found["people"] == [1.5, 2.0, 2.0]  # from frame 0 on, one of them is alone at first
    assert np.isnan(found["sf"])
    assert found["relaxation"] > 0


def test_networks_with_the_person_himself_are_calibrated(recording: str) -> None:
    term = new_system("nn_self").find_law("network_force")
    assert term is not None
    assert term.self_interaction
    batch = Tracks.of(recording).cut(Convention(), 3)
    starts = {model: row_of(new_system(model, 1)) for model in ("nn", "nn_self")}
    np.testing.assert_array_equal(starts["nn"], starts["nn_self"])
    found = {m: calibrate(m, batch, row, steps=1).row for m, row in starts.items()}
    assert not np.allclose(found["nn"], found["nn_self"])


# -- the page, from invented costs -----------------------------------------------------------


def invented(nearest: float, gain: float, network: float) -> Crowd:
    """One convention costs ``nearest`` at first, and 0.2 more elsewhere; all others 2 m²."""
    study = Crowd(CrowdStudyOptions(cuts=2), {})
    special = Convention("central", 25, "trajectory")
    for how in EVERY:
        cost = nearest if how == special else 2.0
        study.found[key(how)] = {
            "offsets": [0, 12],
            "printed": [cost, cost + 0.2],
            "people": [10.0, 10.0],
            "relaxation": cost / (1 - gain),
            "sf": cost,
            "row": [1.0, 2.0, 3.0],
        }
    for how in to_calibrate(study):
        for model in ("nn", "nn_self"):
            for seed in range(2):
                found = {"J": network + seed, "row": []}
                study.found[network_key(how, model, seed)] = found
    return study


@pytest.fixture(autouse=True)
def step(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Crowd, "step", 0.04)


def read(study: Crowd) -> tuple[str, dict[str, pd.DataFrame], dict[str, Any]]:
    found = section(study)
    tables = [block for block in found if isinstance(block, TableBlock)]
    words = "\n".join(block.markdown for block in found if isinstance(block, Text))
    return words, {t.name: t.frame for t in tables}, {t.name: t.bold for t in tables}


def test_a_cost_within_reach_is_told() -> None:
    study = invented(nearest=5.0, gain=0.02, network=1.5)
    words, tables, bold = read(study)
    assert to_calibrate(study)[:2] == [Convention(), Convention("central", 25, "trajectory")]
    assert "with *central, 25, trajectory*: 5.0000 m² (-1.7%)" in words
    assert "own convention, *forward, 26, sequence*, is off by -60.7%." in words
    # once as printed; without 1/2, others cost 4 to 4.4
    assert "1 combinations of convention and mean have the printed J_SF" in words
    at = ("central", 25, "trajectory")
    assert list(tables["crowd_conventions"].loc[at, ["from", "to"]]) == [5.0, 5.2]
    assert bold["crowd_conventions"].loc[at, "to"]
    assert bold["crowd_conventions"].to_numpy().sum() == 2
    means = tables["crowd_conventions_means"]
    assert means.loc[("yes", "yes", "person"), "greatest"] == pytest.approx(5.2 * 0.04 / 10)
    assert means.loc[("no", "no", "sequence"), "least"] == 4.0
    networks = tables["crowd_conventions_networks"]
    assert networks.loc[("forward", 26, "sequence", "all j"), "NN, greatest"] == 2.5
    assert len(networks) == 6


@pytest.mark.parametrize(
    ("gain", "said"),
    [
        (0.02, "at most 2.0%: where J_SF is 5.0841, the relaxation alone has at most 5.188 m²."),
        (0.02, f"the printed J_NN = {COSTS['nn']} is no minimum"),
        (0.2, "This leaves room for the printed J_NN"),
    ],
)
def test_whether_the_printed_network_can_be_a_minimum(gain: float, said: str) -> None:
    words, _, _ = read(invented(nearest=3.0, gain=gain, network=1.0))
    assert said in words
    assert "No combination of convention and mean has the printed J_SF" in words
