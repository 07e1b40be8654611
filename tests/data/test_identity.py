"""Identifiers of agents: restarted, continued, and reused for other agents."""

from __future__ import annotations

import logging
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from nnode.data.clusters import clusters, index_of
from nnode.data.identity import given_anew, identify
from nnode.data.limits import LIMITS
from nnode.data.options import Agents, Faults, SplitOptions
from nnode.data.prepare import prepare
from nnode.data.readers.juelich import JuelichOptions
from nnode.data.readers.table import TableOptions
from nnode.data.readers.vehicles import VehicleTableOptions
from nnode.data.sequence import Sequence
from nnode.data.split import split
from tests.builders import people

DT = 0.1


def world(domain: str, seed: int, seconds: float = 12.0, agents: int = 4) -> np.ndarray:
    """Positions (K, N, D) of agents who follow each other, or who walk in a room of 8 m."""
    rng = np.random.default_rng(seed)
    time = np.arange(round(seconds / DT) + 1) * DT
    if domain == "traffic":
        speed = rng.uniform(8, 14) + rng.uniform(-1, 1, agents)
        start = np.cumsum(rng.uniform(20, 40, agents))
        return (start + time[:, None] * speed)[:, :, None]
    phase = rng.uniform(0, 2 * np.pi, (agents, 2))
    return 4 + 4 * np.sin(0.25 * time[:, None, None] + phase)


def cut(
    x: np.ndarray, name: str, first: int = 0, samples: int | None = None, clock: float = 0.0
) -> Sequence:
    """Samples from ``first`` on of a world that starts at ``clock``; the agents are 0, 1, 2, ..."""
    part = x[first:] if samples is None else x[first : first + samples]
    agents = tuple(map(str, range(x.shape[1])))
    return people(part, DT, start=clock + DT * first, name=f"run/{name}", agents=agents)


def groups(sequences: list[Sequence], domain: str, mode: str = "auto") -> int:
    """Number of groups of sequences that share an agent."""
    named, _ = identify(sequences, domain, Agents[mode])
    unique = (replace(s, agents=names) for s, names in zip(sequences, named, strict=True))
    return int(clusters(index_of(unique), 0.0).max()) + 1


domains = pytest.mark.parametrize("domain", ["traffic", "crowd"])


@domains
def test_restarted_clocks_and_identifiers(domain: str) -> None:
    sequences = [cut(world(domain, i, 6 + i % 3), str(i)) for i in range(8)]
    named, (note,) = identify(sequences, domain, Agents.auto)
    assert named[0] == ("0", "1", "2", "3")
    assert named[3] == ("0#4", "1#4", "2#4", "3#4")
    assert note.startswith("run: identifiers belong to their sequence, because run/")
    assert groups(sequences, domain) == 8
    assert groups(sequences, domain, "global") == 1


@domains
@pytest.mark.parametrize(("step", "samples"), [(20, 21), (20, 20), (10, 21), (25, 15)])
def test_windows_of_one_recording_keep_their_agents(domain: str, step: int, samples: int) -> None:
    """Windows that share a sample, are adjacent, overlap, or are separated by pauses."""
    x = world(domain, 1)
    sequences = [cut(x, str(k), k * step, samples) for k in range(4)]
    named, notes = identify(sequences, domain, Agents.auto)
    assert named == [s.agents for s in sequences]
    assert not notes
    assert groups(sequences, domain, "sequence") == 4


@domains
@pytest.mark.parametrize("samples", [21, 20])
@pytest.mark.parametrize("order", ["runs", "times"])
def test_windows_of_several_runs_in_one_recording(domain: str, samples: int, order: str) -> None:
    runs = [world(domain, seed) for seed in range(3)]
    places = [(run, k) for run in range(3) for k in range(5)]
    if order == "times":
        places.sort(key=lambda place: place[1])
    sequences = [cut(runs[run], f"{run}-{k}", 20 * k, samples) for run, k in places]
    named, (note,) = identify(sequences, domain, Agents.auto)
    assert "one of 3 runs of sequences that carry on" in note
    assert groups(sequences, domain) == 3
    assert len(set(named)) == 3


@domains
def test_same_path_in_all_runs_does_not_join_them(domain: str) -> None:
    """Such as a leader with a prescribed speed, or a person who stands still."""
    x = [world(domain, seed, agents=3) for seed in range(4)]
    for other in x[1:]:
        other[:, 2] = x[0][:, 2]
    assert groups([cut(path, str(i)) for i, path in enumerate(x)], domain) == 4


@pytest.mark.parametrize(("factor", "expected"), [(0.99, 1), (1.01, 2)])
def test_positions_may_differ_by_the_noise(factor: float, expected: int) -> None:
    x = world("traffic", 0)
    windows = [cut(x, "a", 0, 41), cut(x + LIMITS["traffic"].noise * factor, "b", 20, 41)]
    assert groups(windows, "traffic") == expected


def test_single_swap_does_not_separate_windows() -> None:
    """Two cars exchange their names in one window, which is a fault; the other cars continue."""
    x = world("traffic", 2)
    wrong = x[:, [1, 0, 2, 3]]
    sequences = [cut(wrong if k == 2 else x, str(k), 20 * k, 21) for k in range(5)]
    named, notes = identify(sequences, "traffic", Agents.auto)
    assert named == [s.agents for s in sequences]
    assert not notes


@domains
@pytest.mark.parametrize("pause", [0.1, 0.5])
def test_restarted_identifiers_on_a_continued_clock(domain: str, pause: float) -> None:
    sequences, clock = [], 0.0
    for i in range(6):
        sequences.append(cut(world(domain, i, 6.0, agents=6), str(i), clock=clock))
        clock = sequences[-1].time[-1] + pause
    assert groups(sequences, domain) == 6
    _, (note,) = identify(sequences, domain, Agents.auto)
    assert "6 identifiers are used again for another agent" in note


def test_reused_identifier() -> None:
    x = world("traffic", 3, agents=5)
    x[61:, 4] = x[61:, 0] - 30  # car 4 has left; another car with its name enters at the rear
    early, late = cut(x, "early", 0, 61), cut(x, "late", 70, 40)
    named, (note,) = identify([early, late], "traffic", Agents.auto)
    assert named == [early.agents, ("0", "1", "2", "3", "4#2")]
    assert note == (
        "run: 1 identifiers are used again for another agent, who cannot have come from where the "
        "one before was (such as 4, another one from 7 s on in run/late)"
    )


@pytest.mark.parametrize(
    ("gap", "end", "another"),
    [
        (2.0, 120.0, False),  # continues at 10 m/s
        (2.0, 96.0, False),  # behind, but a possible path
        (2.0, 94.0, True),
        (2.0, 226.0, True),  # faster than 60 m/s
        (9.9, 200.0, False),
        (10.1, 200.0, True),  # the limit is 10 s
    ],
)
def test_holes_in_a_record(gap: float, end: float, another: bool) -> None:
    time = np.array([0.0, 5.0, 5.0 + gap, 6.0 + gap, 0.0, 10.0])
    x = np.array([50.0, 100.0, end, end + 10, 0.0, 100.0])
    other, hole = np.zeros((2, 5), dtype=bool)
    other[3] = hole[1] = True
    assert given_anew(time, x, other, hole).tolist() == [False, another, False, False, False]


def test_new_identifiers_are_unique() -> None:
    sequences = [cut(world("traffic", i), str(i)) for i in range(2)]
    sequences[0] = replace(sequences[0], agents=("0", "0#2", "2", "3"))
    named, _ = identify(sequences, "traffic", Agents.sequence)
    assert named[1] == ("0#2#", "1", "2#2", "3#2")


def test_faulty_sequences_are_accepted() -> None:
    absent = np.full((3, 2, 1), np.nan)
    short, valid = cut(world("traffic", 0), "b", 0, 1), cut(world("traffic", 1), "d")
    sequences = [cut(absent, "a"), short, cut(absent, "c"), valid]
    named, _ = identify(sequences, "traffic", Agents.auto)
    assert [len(names) for names in named] == [2, 4, 2, 4]
    nameless = Sequence(name="n", recording="run", time=np.arange(3.0), x=np.zeros((3, 2, 1)))
    assert identify([nameless], "traffic", Agents.sequence)[0] == [()]


def table(path: Path, domain: str, sequences: int = 10, restart: bool = True) -> TableOptions:
    """Write a tidy table; agents, and times with ``restart``, start at 0 in every sequence."""
    rows = []
    for i in range(sequences):
        x = world(domain, i, 3.0)
        start = 0.0 if restart else 3.2 * i
        for k, n in np.ndindex(x.shape[:2]):
            place = dict(zip("xy", x[k, n], strict=False))
            rows.append({"sequence": i, "time": start + DT * k, "agent": n, **place})
    pd.DataFrame(rows).to_csv(path, index=False)
    return TableOptions(domain=domain, path=str(path))


@domains
@pytest.mark.parametrize("restart", [True, False])
def test_table_of_numbered_agents_can_be_split(
    tmp_path: Path, domain: str, restart: bool, caplog: pytest.LogCaptureFixture
) -> None:
    options = table(tmp_path / "t.csv", domain, restart=restart)
    with caplog.at_level(logging.INFO):
        store = prepare(options, tmp_path / "out")
    messages = [
        r.getMessage() for r in caplog.records if "data.agents decides by hand" in r.message
    ]
    assert len(messages) == 1
    parts = split(store, SplitOptions())
    assert (len(parts.train), len(parts.heldout), parts.dropped) == (8, 2, [])
    assert store[1].agents == tuple(store.index[1]["agents"]) == ("0#2", "1#2", "2#2", "3#2")
    assert len(store.manifest["identifiers"]) == 1
    options.agents = Agents["global"]
    store = prepare(options, tmp_path / "out")
    assert store[1].agents == ("0", "1", "2", "3")
    assert store.manifest["identifiers"] == []


def test_faults_name_the_identifiers_of_the_source(tmp_path: Path) -> None:
    options = table(tmp_path / "t.csv", "traffic")
    frame = pd.read_csv(options.path)
    frame.loc[(frame.sequence == 4) & (frame.agent == 2) & (frame.time > 1), "x"] += 40
    frame.to_csv(options.path, index=False)
    options.faults = Faults.keep
    store = prepare(options, tmp_path / "out")
    (jump,) = (f for f in store.manifest["faults"] if f["kind"] == "jump")
    assert (jump["sequence"], jump["names"]) == ("t/4", ["2"])
    assert store[4].agents[jump["agents"][0]] == "2#5"


@pytest.mark.real
def test_identifiers_of_real_recordings(real_data: Path, tmp_path: Path) -> None:
    corridor = JuelichOptions(source=str(real_data), walls={"*": [0.0, 4.0]}, t_seq=3.0)
    road = VehicleTableOptions(
        source=str(real_data),
        path="ngsim/i80_lanes_1_2.csv",
        columns={"vehicle": "veh", "time": "t", "speed": "v", "kind": "cls"},
        window=10.0,
    )
    for options in (corridor, road):
        assert prepare(options, tmp_path / "out").manifest["identifiers"] == []
