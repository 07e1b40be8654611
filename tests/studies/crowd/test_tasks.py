"""The crowd study's tasks on people who are simulated by the social force."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from nnode.data.store import write_store
from studies.crowd import tasks
from studies.crowd.data import chosen
from studies.crowd.tasks import costs, system_of
from tests.studies.crowd.corridor import DT, walkers

TRUE = np.array([0.05, 40.0, 12.0])
#: Starts of the sequences (s): two in each half of the recording, in four groups of 10 s.
STARTS = (0.0, 10.0, 20.0, 30.0)
PEOPLE = 30


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> str:
    sequences = []
    for number, start in enumerate(STARTS):
        truth = system_of("sf", TRUE)
        (s,) = walkers(number, system=truth, samples=26, people=PEOPLE, number=1)
        agents = tuple(f"{number}-{i}" for i in range(PEOPLE))
        time = start + DT * np.arange(26)
        sequences.append(
            replace(s, name=f"made/{number}", recording="made", time=time, agents=agents)
        )
    path = tmp_path_factory.mktemp("crowd")
    write_store(path, sequences, {"dt": DT})
    return str(path)


def test_fit_recovers_the_truth_and_tests_the_held_out_block(folder: str) -> None:
    result = tasks.fit("sf", folder, "fold-1", 2, [0.0, 31.0], 0, (1.2 * TRUE).tolist(), 4)
    assert result["row"] == pytest.approx(TRUE, rel=1e-3)
    assert list(result["train"]) == ["made/0", "made/1"]
    assert list(result["heldout"]) == ["made/2", "made/3"]
    assert result["J"] == pytest.approx(np.mean(list(result["train"].values())))
    # people in the held-out block obey the same law
    baseline = tasks.baselines(folder)["costs"]["relaxation"]
    assert max(result["heldout"].values()) < 1e-4 * min(baseline.values())


def test_refits_to_resampled_exact_data_recover_the_truth(folder: str) -> None:
    result = tasks.resample(folder, TRUE.tolist(), 5, 1, 4, 0)
    assert np.array(result["rows"]).shape == (3, 3)
    for row in result["rows"]:
        assert row == pytest.approx(TRUE, rel=1e-3)


def test_baselines_of_all_sequences(folder: str) -> None:
    result = tasks.baselines(folder)
    names = [f"made/{number}" for number in range(4)]
    assert all(list(by_name) == names for by_name in result["costs"].values())
    # the baseline without interaction is the social force with zero strengths
    expected = costs("sf", [0.0, 0.0, 0.0], chosen(folder, range(4)))
    assert list(result["costs"]["relaxation"].values()) == pytest.approx(
        expected.tolist(), rel=1e-9
    )


def test_transfer_of_an_isotropic_force(folder: str) -> None:
    result = tasks.transfer(folder, {"sf": TRUE.tolist()})["runs"]["made"]
    baselines = tasks.baselines(folder)["costs"]
    for name, costs_along in baselines.items():
        assert result[name] == pytest.approx(costs_along, rel=1e-6)
    assert max(result["sf"].values()) < 1e-4 * min(baselines["relaxation"].values())
