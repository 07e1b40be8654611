"""Who is who: identifiers that start again, that go on, and that are given away anew."""

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
from nnode.data.readers.table import TableOptions
from nnode.data.sequence import Sequence
from nnode.data.split import split
from tests.builders import people

DT = 0.1


def world(domain: str, seed: int, seconds: float = 12.0, agents: int = 4) -> np.ndarray:
    """Positions (K, N, D) of agents who follow each other, or who walk about a room of 8 m."""
    draw = np.random.default_rng(seed)
    time = np.arange(round(seconds / DT) + 1) * DT
    if domain == "traffic":
        pace = draw.uniform(8, 14) + draw.uniform(-1, 1, agents)
        start = np.cumsum(draw.uniform(20, 40, agents))
        return (start + time[:, None] * pace)[:, :, None]
    phase = draw.uniform(0, 2 * np.pi, (agents, 2))
    return 4 + 4 * np.sin(0.25 * time[:, None, None] + phase)


def cut(
    x: np.ndarray, name: str, first: int = 0, samples: int | None = None, clock: float = 0.0
) -> Sequence:
    """Samples ``first`` and on of a world whose clock starts at ``clock``, agents 0, 1, 2, ..."""
    part = x[first:] if samples is None else x[first : first + samples]
    agents = tuple(map(str, range(x.shape[1])))
    return people(part, DT, start=clock + DT * first, name=f"run/{name}", agents=agents)


def groups(sequences: list[Sequence], domain: str, mode: str = "auto") -> int:
    """Number of groups of sequences that share an agent."""
    named, _ = identify(sequences, domain, Agents[mode])  # type: ignore[arg-type]
    unique = (replace(s, agents=names) for s, names in zip(sequences, named, strict=True))
    return int(clusters(index_of(unique), 0.0).max()) + 1


domains = pytest.mark.parametrize("domain", ["traffic", "crowd"])


@domains
def test_clocks_and_identifiers_that_start_again(domain: str) -> None:
    sequences = [cut(world(domain, i, 6 + i % 3), str(i)) for i in range(8)]
    named, (note,) = identify(sequences, domain, Agents.auto)  # type: ignore[arg-type]
    assert named[0] == ("0", "1", "2", "3")
    assert named[3] == ("0#4", "1#4", "2#4", "3#4")
    assert note.startswith("run: identifiers belong to their sequence, because run/")
    assert groups(sequences, domain) == 8
    assert groups(sequences, domain, "global") == 1


@domains
@pytest.mark.parametrize(("step", "samples"), [(20, 21), (20, 20), (10, 21), (25, 15)])
def test_windows_of_one_recording_keep_their_agents(domain: str, step: int, samples: int) -> None:
    """Windows that share a sample, that follow at once, that overlap, and with pauses between."""
    x = world(domain, 1)
    sequences = [cut(x, str(k), k * step, samples) for k in range(4)]
    named, notes = identify(sequences, domain, Agents.auto)  # type: ignore[arg-type]
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
    named, (note,) = identify(sequences, domain, Agents.auto)  # type: ignore[arg-type]
    assert "one of 3 runs of sequences that carry on" in note
    assert groups(sequences, domain) == 3
    assert len(set(named)) == 3


@domains
def test_an_agent_who_does_the_same_in_all_runs_makes_them_no_one_world(domain: str) -> None:
    """Such as a leader on a prescribed course, or somebody who stands still."""
    x = [world(domain, seed, agents=3) for seed in range(4)]
    for other in x[1:]:
        other[:, 2] = x[0][:, 2]
    assert groups([cut(path, str(i)) for i, path in enumerate(x)], domain) == 4


def test_positions_may_differ_by_their_error() -> None:
    x = world("traffic", 0)
    off = [cut(x, "a", 0, 41), cut(x + LIMITS["traffic"].noise * 0.99, "b", 20, 41)]
    assert groups(off, "traffic") == 1
    off[1] = cut(x + LIMITS["traffic"].noise * 1.01, "b", 20, 41)
    assert groups(off, "traffic") == 2


def test_one_fault_does_not_part_windows() -> None:
    """Two cars that exchange their names in one window are a fault; its other cars go on."""
    x = world("traffic", 2)
    wrong = x[:, [1, 0, 2, 3]]
    sequences = [cut(wrong if k == 2 else x, str(k), 20 * k, 21) for k in range(5)]
    named, notes = identify(sequences, "traffic", Agents.auto)
    assert named == [s.agents for s in sequences]
    assert not notes


@domains
@pytest.mark.parametrize("pause", [0.1, 0.5])
def test_identifiers_that_start_again_on_a_clock_that_does_not(domain: str, pause: float) -> None:
    sequences, clock = [], 0.0
    for i in range(6):
        sequences.append(cut(world(domain, i, 6.0, agents=6), str(i), clock=clock))
        clock = sequences[-1].time[-1] + pause
    assert groups(sequences, domain) == 6
    _, (note,) = identify(sequences, domain, Agents.auto)  # type: ignore[arg-type]
    assert "6 identifiers are used again for another agent" in note


def test_an_identifier_that_is_given_to_another_vehicle_later() -> None:
    x = world("traffic", 3, agents=5)
    x[61:, 4] = x[61:, 0] - 30  # car 4 has left; the next one that bears its name enters behind
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
        (2.0, 120.0, False),  # 10 m/s on
        (2.0, 96.0, False),  # further back, but within the reach of a path
        (2.0, 94.0, True),
        (2.0, 226.0, True),  # faster than 60 m/s
        (9.9, 200.0, False),
        (10.1, 200.0, True),  # nobody is in view for more than 10 s
    ],
)
def test_holes_in_a_vehicle_s_record(gap: float, end: float, another: bool) -> None:
    time = np.array([0.0, 5.0, 5.0 + gap, 6.0 + gap, 0.0, 10.0])
    x = np.array([50.0, 100.0, end, end + 10, 0.0, 100.0])
    other, hole = np.zeros((2, 5), dtype=bool)
    other[3] = hole[1] = True
    assert given_anew(time, x, other, hole).tolist() == [False, another, False, False, False]


def test_a_number_that_is_a_name_already_is_not_given() -> None:
    sequences = [cut(world("traffic", i), str(i)) for i in range(2)]
    odd = Sequence(**{**vars(sequences[0]), "agents": ("0", "0#2", "2", "3")})
    named, _ = identify([odd, sequences[1]], "traffic", Agents.sequence)
    assert named[1] == ("0#2#", "1", "2#2", "3#2")


def test_odd_sequences_are_left_alone() -> None:
    """Faults are not judged here: they must not raise either."""
    nobody = np.full((3, 2, 1), np.nan)
    single = cut(world("traffic", 0), "one", 0, 1)
    odd = [cut(nobody, "nobody"), single, cut(nobody, "again"), cut(world("traffic", 1), "sound")]
    named, _ = identify(odd, "traffic", Agents.auto)
    assert [len(names) for names in named] == [2, 4, 2, 4]
    nameless = Sequence(name="n", recording="run", time=np.arange(3.0), x=np.zeros((3, 2, 1)))
    assert identify([nameless], "traffic", Agents.sequence)[0] == [()]


def table(path: Path, domain: str, sequences: int = 10, restart: bool = True) -> TableOptions:
    """The tidy table that people write first: agents and times from 0 in every sequence."""
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
def test_a_table_of_numbered_agents_can_be_split(
    tmp_path: Path, domain: str, restart: bool, caplog: pytest.LogCaptureFixture
) -> None:
    options = table(tmp_path / "t.csv", domain, restart=restart)
    with caplog.at_level(logging.INFO):
        store = prepare(options, tmp_path / "out")
    told = [r.getMessage() for r in caplog.records if "data.agents decides by hand" in r.message]
    assert len(told) == 1
    parts = split(store, SplitOptions())
    assert (len(parts.train), len(parts.heldout), parts.dropped) == (8, 2, [])
    assert store[1].agents == tuple(store.index[1]["agents"]) == ("0#2", "1#2", "2#2", "3#2")
    assert len(store.manifest["identifiers"]) == 1
    options.agents = Agents["global"]
    store = prepare(options, tmp_path / "out")
    assert store[1].agents == ("0", "1", "2", "3")
    assert store.manifest["identifiers"] == []


def test_faults_are_told_with_the_source_s_identifiers(tmp_path: Path) -> None:
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
def test_real_recordings_keep_their_identifiers(real_data: Path, tmp_path: Path) -> None:
    from nnode.data.readers.juelich import JuelichOptions
    from nnode.data.readers.vehicles import VehicleTableOptions

    corridor = JuelichOptions(source=str(real_data), walls={"*": [0.0, 4.0]}, t_seq=3.0)
    road = VehicleTableOptions(
        source=str(real_data),
        path="ngsim/i80_lanes_1_2.csv",
        columns={"vehicle": "veh", "time": "t", "speed": "v", "kind": "cls"},
        window=10.0,
    )
    for options in (corridor, road):
        assert prepare(options, tmp_path / "out").manifest["identifiers"] == []
