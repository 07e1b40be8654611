"""Parts of the crowd study on small synthetic corridors."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from nnode.data.sequence import Sequence, collate
from nnode.data.store import write_store
from nnode.plots.interaction import evaluate_force, interaction
from studies.crowd import forces as crowd_forces
from studies.crowd import printed
from studies.crowd.data import ALL, fold_of, parts, time_groups, turned
from studies.crowd.results import beside_printed
from studies.crowd.tasks import calibrate, costs, even_pace, new_system, row_of, system_of
from tests.studies.crowd.corridor import corridor, sequence, walkers

TRUE = np.array([0.05, 40.0, 12.0])


def chain(folder: Path, number: int = 20) -> str:
    """Consecutive sequences of one second; successive ones share half of their people."""
    rng = np.random.default_rng(0)
    sequences = []
    for i in range(number):
        people = tuple(str(p) for p in range(2 * i, 2 * i + 4))
        sequences.append(replace(sequence(rng, i, 26, 4), agents=people))
    write_store(folder, sequences, {"dt": 0.04})
    return str(folder)


def test_folds_share_no_people_and_hold_out_each_sequence_once(tmp_path):
    folder = chain(tmp_path / "store")
    held: list[int] = []
    for fold in range(4):
        train, out = parts(folder, f"fold-{fold}", 4, (0.0, 20.0))
        assert train
        assert out
        people, held_out_people = (
            {2 * i + k for i in part for k in range(4)} for part in (train, out)
        )
        assert not people & held_out_people
        held += out
    assert sorted(held) == list(range(20))
    assert parts(folder, ALL, 4, (0.0, 20.0)) == (list(range(20)), [])


def test_sequence_across_a_border_is_in_no_block():
    starts = np.array([0.0, 4.0, 5.0, 9.5])
    result = fold_of(starts, starts + 1.5, 2, (0.0, 11.0))
    assert result.tolist() == [0, 0, -1, 1]


def test_time_groups():
    rng = np.random.default_rng(0)
    items = [sequence(rng, i, 26, 2) for i in (0, 3, 10, 11)]
    items.append(replace(items[0], recording="another"))
    assert time_groups(items).tolist() == [0, 0, 1, 1, 2]


def test_only_anisotropic_forces_depend_on_the_corridor_s_direction():
    rng = np.random.default_rng(1)
    along_x = [sequence(rng, i, 20, 15) for i in range(2)]
    turn = np.array([[0.0, 1.0], [-1.0, 0.0]])  # to the left, along y

    def left(s: Sequence) -> Sequence:
        assert s.walls is not None
        assert s.destination is not None
        walls = (s.walls.reshape(-1, 2, 2) @ turn).reshape(-1, 4)
        return replace(s, x=s.x @ turn, destination=s.destination @ turn, walls=walls)

    along_y = [left(s) for s in along_x]
    expected = costs("sf", TRUE, collate(along_x))
    torch.testing.assert_close(costs("sf", TRUE, collate(along_y)), expected)
    back = [turned(s) for s in along_y]
    for before, after in zip(along_x, back, strict=True):
        np.testing.assert_allclose(after.x, before.x, atol=1e-12)
        assert before.walls is not None
        assert after.walls is not None
        np.testing.assert_allclose(after.walls, before.walls, atol=1e-12)
    network = row_of(new_system("nn", 4))
    expected = costs("nn", network, collate(along_x))
    assert not np.allclose(costs("nn", network, collate(along_y)), expected)
    torch.testing.assert_close(costs("nn", network, collate(back)), expected)


@pytest.mark.thorough
@pytest.mark.parametrize("seed", [0, 2])
def test_parameters_are_recovered_from_the_paper_s_starts(seed):
    batch = corridor(3, system=system_of("sf", TRUE), samples=26, people=40, number=4)
    start = row_of(new_system("sf", seed))
    assert start.max() > 10
    row, _ = calibrate("sf", batch, start)
    assert row == pytest.approx(TRUE, rel=1e-3)


def test_weights_of_sequences():
    batch = collate(
        walkers(seed, system=system_of("sf", row), samples=26, people=60, number=1)[0]
        for seed, row in ((1, TRUE), (2, 2 * TRUE))
    )
    row, _ = calibrate("sf", batch, TRUE, weights=np.array([0.0, 1.0]))
    assert row == pytest.approx(2 * TRUE, rel=1e-3)


@pytest.mark.thorough
def test_network_of_walls_has_no_pair_force_and_is_trained():
    batch = corridor(3, system=system_of("sf", 50 * TRUE), people=20)
    start = row_of(new_system("nn", 5))
    row, _ = calibrate("nn", batch, start, people=False, steps=2)
    system = system_of("nn", row)
    dx, dv = np.random.default_rng(0).normal(size=(2, 50, 2))
    assert np.abs(evaluate_force(system, dx, dv, "pair")).max() == 0.0
    assert np.abs(evaluate_force(system, dx, dv, "wall")).max() > 0.0
    first, _ = calibrate("nn", batch, start, people=False, steps=1, grow=False)
    assert costs("nn", row, batch).mean() < costs("nn", first, batch).mean()


def test_even_pace_is_constant_and_arrives_in_time():
    batch = corridor(1)
    x = even_pace(batch).x
    torch.testing.assert_close(x[-1], batch.destination)
    step = (x[1:] - x[:-1])[:, batch.agent]
    torch.testing.assert_close(step, step[:1].expand_as(step))


def test_force_by_distance_as_the_formula():
    measured = crowd_forces.Measured.of(corridor(5, people=120, number=2))
    system = system_of("sf", [0.5, 30.0, 0.0])
    result = crowd_forces.away_by_distance(system, measured)
    distance = np.linalg.norm(measured.dx, axis=1)
    inside = (distance >= 0.25) & (distance < 0.5) & measured.facing
    assert inside.sum() >= crowd_forces.LEAST
    d = distance[inside]
    expected = (0.5 * np.exp((0.5 - d) / 0.05) + 30.0 * (0.5 - d)).mean()
    assert result.loc[0.375, "facing"] == pytest.approx(expected, rel=1e-6)


def test_pair_and_wall_forces_add_up():
    measured = crowd_forces.Measured.of(corridor(6))
    system = new_system("nn", 8)
    result = crowd_forces.accelerations(system, measured)
    np.testing.assert_allclose(result["sum"], result["pair"] + result["wall"])
    assert result["sum"].shape == (int(measured.scenes.agent.sum()), 2)
    assert interaction(system) is system.terms[1]


def test_relaxation_to_a_speed_is_estimated():
    v = np.array([[0.5, 0.0], [-1.0, 0.2], [1.5, 0.1], [-0.8, 0.0]])
    relaxation = 0.4 * (np.sign(v[:, :1]) * 1.2 - v[:, :1])
    parts = {"v": v, "sum": np.concatenate([relaxation, np.zeros((4, 1))], 1)}
    assert crowd_forces.slope(parts) == pytest.approx((0.4, 1.2))


def test_likeness_is_a_correlation():
    field = np.random.default_rng(0).normal(size=(100, 2))
    assert crowd_forces.likeness(field, 3 * field + 7) == pytest.approx(1.0)
    assert crowd_forces.likeness(field, -field) == pytest.approx(-1.0)
    assert np.isnan(crowd_forces.likeness(field, 0 * field))


def test_forces_as_printed():
    from nnode.plots.settings import six_settings

    system = system_of("sf", list(printed.parameters.values()))
    table = beside_printed("sf", six_settings(system)[1])
    assert len(table) == 12
    for part in ("F_x", "F_y"):
        np.testing.assert_allclose(table[part], table[f"{part} printed"], rtol=0, atol=1e-4)
