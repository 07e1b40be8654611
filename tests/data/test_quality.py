"""Faults are found where they were planted, and nowhere else."""

from __future__ import annotations

import tracemalloc
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from nnode.data import quality
from nnode.data.limits import LIMITS
from nnode.data.quality import KINDS, Fault, find_faults, usable
from nnode.data.readers.esimas import read_esimas
from nnode.data.readers.juelich import JuelichOptions, juelich_files, read_juelich
from nnode.data.readers.vehicles import VehicleTableOptions, read_vehicles
from nnode.data.sequence import Domain, Sequence
from nnode.data.smooth import measured_noise
from nnode.plots.quality import STYLES, faults_figure, plot_faults
from tests.builders import lane, straight
from tests.builders import people as paths


def platoon(n: int = 3, k: int = 8, dt: float = 0.2, speed: float = 25.0) -> Sequence:
    x = 5.0 + speed * dt * np.arange(k)[:, None] + 30.0 * np.arange(n)
    return lane(x, dt, start=10.0)


def people(n: int = 4, k: int = 26, dt: float = 0.04) -> Sequence:
    number, velocity = np.arange(n), np.zeros((n, 2))
    velocity[:, 0] = 1.3 * (-1.0) ** number
    start = np.stack([np.zeros(n), 0.8 * number + 0.5], axis=1)
    sequence = straight(start, velocity, k, dt, agents=tuple(f"p{i}" for i in number))
    return replace(sequence, v=None)


def changed(sequence: Sequence, at: tuple, value: object) -> Sequence:
    x = sequence.x.copy()
    x[at] = value
    return replace(sequence, x=x)


def kinds(sequence: Sequence, domain: Domain = "traffic", noise: float = 0.0) -> list[str]:
    return [fault.kind for fault in find_faults(sequence, domain, noise)]


@given(
    speed=st.floats(0.0, 55.0),
    noise=st.floats(0.0, 0.2),
    dt=st.sampled_from([0.04, 0.1, 0.2, 1.0]),
    seed=st.integers(0, 1000),
)
@settings(deadline=None)
def test_noisy_platoons_have_no_fault(speed: float, noise: float, dt: float, seed: int) -> None:
    s = platoon(dt=dt, speed=speed)
    error = np.random.default_rng(seed).uniform(-noise, noise, s.x.shape)
    assert kinds(replace(s, x=s.x + error)) == []


def test_clean_people_have_no_fault() -> None:
    assert kinds(people(), "crowd") == []


@pytest.mark.parametrize("dt", [0.04, 0.1])
def test_noisy_people_do_not_jump(dt: float) -> None:
    for seed in range(20):
        s = people(k=60, dt=dt)
        noisy = s.x + np.random.default_rng(seed).normal(0.0, 0.1, s.x.shape)
        noise = measured_noise([replace(s, x=noisy)]).position
        assert kinds(replace(s, x=noisy), "crowd", noise) == []
        # a true jump is detected
        noisy[30:, 2] += (1.0, 0.8)
        assert kinds(replace(s, x=noisy), "crowd", noise) == ["jump"]


PLATOON = platoon().x
TWO = platoon(n=2).x


@pytest.mark.parametrize(
    ("sequence", "at", "value", "kind", "agents", "sample"),
    [
        (platoon(), np.s_[:, 1], 0.0, "zero_row", (1,), 0),
        # two cars exchange their identifiers
        (platoon(), np.s_[4:, [0, 1]], PLATOON[4:, [1, 0]], "identity_swap", (0, 1), 4),
        # the leader leaves and a car enters at the rear: every row continues with the car ahead
        (
            platoon(),
            np.s_[5:],
            np.concatenate([PLATOON[5:, :1] - 20.0, PLATOON[5:, :-1]], axis=1),
            "identity_swap",
            (0, 1, 2),
            5,
        ),
        # a step that no exchange explains
        (platoon(), np.s_[4:, 2], PLATOON[4:, 2] + 20.0, "jump", (2,), 4),
        # a car overtakes between two samples; the distance is never below 2 m
        (
            platoon(n=2),
            np.s_[:, 0, 0],
            TWO[:, 0, 0] + 6.5 * np.arange(8) - 0.2,
            "overtaking",
            (0, 1),
            5,
        ),
        (platoon(), np.s_[2:4, 1], np.nan, "gap_in_time", (1,), 2),
        (people(), np.s_[10:, [0, 2]], people().x[10:, [2, 0]], "identity_swap", (0, 2), 10),
        (people(), np.s_[10:, 1, 1], 30.0, "jump", (1,), 10),
    ],
)
def test_planted_fault(
    sequence: Sequence,
    at: tuple,
    value: object,
    kind: str,
    agents: tuple[int, ...],
    sample: int,
) -> None:
    domain: Domain = "traffic" if sequence.x.shape[2] == 1 else "crowd"
    (fault,) = find_faults(changed(sequence, at, value), domain)
    assert (fault.kind, fault.agents) == (kind, agents)
    assert fault.time == pytest.approx(sequence.time[sample])
    if sequence.agents and agents[0] == 0:
        assert "p0" in fault.detail


def test_car_may_start_at_the_origin() -> None:
    s = platoon()
    assert kinds(replace(s, x=s.x - s.x[0, 0])) == []


def test_displacement_limit_is_proportional_to_the_interval() -> None:
    for dt, step, expected in ((0.2, 13.0, ["jump"]), (0.4, 13.0, []), (0.4, 25.0, ["jump"])):
        s = platoon(n=2, dt=dt)
        assert kinds(changed(s, np.s_[5:, 1], s.x[5:, 1] + step - 25.0 * dt)) == expected


@pytest.mark.parametrize(("step", "expected"), [(-0.4, []), (-1.5, ["backward"]), (-3.0, ["jump"])])
def test_backward(step: float, expected: list[str]) -> None:
    s = platoon(n=2, speed=5.0)
    assert kinds(changed(s, np.s_[4:, 0], s.x[4:, 0] + step - 1.0)) == expected


@pytest.mark.parametrize(
    ("length", "expected"), [(29.0, []), (30.4, []), (30.6, ["overlap"]), (100.0, ["overlap"])]
)
def test_overlap_by_vehicle_lengths(length: float, expected: list[str]) -> None:
    """Fronts are 30 m apart; an error of 0.5 m is tolerated."""
    s = replace(platoon(), length=np.array([4.0, np.nan, length]))
    assert kinds(s) == expected
    # the length of the last vehicle does not matter
    assert kinds(replace(s, length=s.length[::-1])) == []
    for fault in find_faults(s, "traffic"):
        assert fault.agents == (1, 2)
        assert "30.00 m behind" in fault.detail
        assert f"{length:.2f} m long, at 8 of 8 samples" in fault.detail


def test_overlap_of_cars() -> None:
    s = platoon(n=2)
    near = changed(s, (slice(3, 5), 0), s.x[3:5, 1] - 1.5)
    (overlap,) = (f for f in find_faults(near, "traffic") if f.kind == "overlap")
    assert "1.50 m apart at 2 of 8 samples" in overlap.detail
    assert kinds(changed(s, np.s_[:, 0], s.x[:, 1] - 2.1)) == []


def test_overlap_of_people() -> None:
    s = people()
    assert kinds(changed(s, np.s_[:, 2], s.x[:, 0] + [0.0, 0.05]), "crowd") == ["overlap"]


def test_duplicates() -> None:
    s = people()
    (fault,) = find_faults(replace(s, agents=("a", "b", "a", "c")), "crowd")
    assert (fault.kind, fault.agents) == ("duplicate", (0, 2))
    same_path = replace(s, x=s.x[:, [0, 1, 1, 3]])
    faults = find_faults(same_path, "crowd")
    assert [f.kind for f in faults] == ["duplicate", "overlap"]
    assert not usable(same_path, faults)


def test_gaps_and_invalid_numbers() -> None:
    s = platoon()
    absent = changed(s, np.s_[2:4, 1], np.nan)
    (fault,) = find_faults(absent, "traffic")
    assert "10.4-10.6 s" in fault.detail
    assert not usable(absent, [fault])
    assert kinds(changed(s, (3, 1), np.inf)) == ["non_finite"]
    assert kinds(changed(people(), (3, 1, 0), np.nan), "crowd") == ["non_finite"]
    time = s.time.copy()
    time[5:] += 0.2
    (fault,) = find_faults(replace(s, time=time), "traffic")
    assert (fault.kind, fault.time) == ("gap_in_time", pytest.approx(time[5]))
    time[2] = np.nan
    assert kinds(replace(s, time=time)) == ["non_finite"]


def test_too_short() -> None:
    assert kinds(platoon(n=1)) == ["too_short"]
    assert kinds(people(n=1), "crowd") == []
    for samples in (1, 2):
        short = platoon(k=samples)
        faults = find_faults(short, "traffic")
        assert usable(short, faults) == (samples == 2)
    assert [fault.kind for fault in faults] == ["too_short"]


@pytest.mark.real
def test_motorway_recording(real_data: Path) -> None:
    sequences = read_esimas(real_data / "esimas" / "sequence_data1-1_1.mat")
    result = {i: {f.kind for f in find_faults(s, "traffic")} for i, s in enumerate(sequences)}
    # Sequences in which positions decrease by 10 m to 25 m although all cars move forward.
    assert [i for i, k in result.items() if "identity_swap" in k] == [0, 11, 15, 18, 32, 33]
    # Sequences with fronts less than 2 m apart, from the raw positions.
    close = [i for i, s in enumerate(sequences) if np.diff(s.x[:, :, 0], axis=1).min() < 2]
    assert [i for i, k in result.items() if "overlap" in k] == close
    (swap,) = [f for f in find_faults(sequences[0], "traffic") if f.kind == "identity_swap"]
    assert swap.agents == (0, 1, 2)
    assert "car 0 carries on as car 1" in swap.detail


@pytest.mark.real
def test_zero_rows_of_the_two_car_family(real_data: Path) -> None:
    first = read_esimas(real_data / "esimas" / "sequence_data_1-1_1.mat")[1]
    zero = {i for i in range(first.n_agents) if (first.x[:, i] == 0).all()}
    assert zero == {2, 3, 4, 5, 6}
    faults = find_faults(first, "traffic")
    assert {f.agents[0] for f in faults if f.kind == "zero_row"} == zero
    assert {f.kind for f in faults} == {"zero_row", "duplicate"}


@pytest.mark.real
def test_real_recordings_without_faults(real_data: Path) -> None:
    options = JuelichOptions(source=str(real_data))
    for path in juelich_files(options).values():
        assert not any(find_faults(s, "crowd") for s in read_juelich(path, options))
    columns: dict[str, str | None] = {"vehicle": "veh", "time": "t", "speed": "v"}
    table = real_data / "ngsim" / "i80_lanes_1_2.csv"
    for s in read_vehicles(table, VehicleTableOptions(columns=columns, window=10.0)):
        assert find_faults(s, "traffic") == []


def test_each_kind_has_a_marker() -> None:
    assert set(STYLES) == set(KINDS)
    assert len({marker for _, marker in STYLES.values()}) == len(KINDS)
    assert set(LIMITS) == {"traffic", "crowd"}


@pytest.mark.parametrize("domain", ["traffic", "crowd"])
def test_plot(tmp_path: Path, domain: Domain) -> None:
    s = platoon() if domain == "traffic" else people()
    many = [replace(s, name=f"r/{i}") for i in range(5)]
    fault = Fault("jump", "", (1,), float(s.time[3]), "")
    faults = {m.name: [fault] for m in many[1:]}
    figure = faults_figure(many, faults, domain, most=2)
    assert len(figure.axes) == 3  # the bars, and two of four sequences
    assert "the first 2 are shown" in figure.axes[0].get_title()
    plot_faults(many[:2], faults, domain, tmp_path / "f.png")
    assert (tmp_path / "f.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.thorough
def test_memory_is_linear_in_the_number_of_vehicles() -> None:
    # the matrix of all distances would need 3.2 GB
    n = 20_000
    x = 20.0 * np.arange(n)[None, :, None] + 2.0 * np.arange(4)[:, None, None]
    x[2:, [5, 6]] = x[2:, [6, 5]]
    x[:, 9] = x[:, 8] + 0.5
    s = lane(x[..., 0], agents=tuple(map(str, range(n))))
    tracemalloc.start()
    try:
        result = {(f.kind, f.agents) for f in find_faults(s, "traffic")}
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert result == {("identity_swap", (5, 6)), ("overlap", (8, 9))}
    assert peak < 200e6


@pytest.mark.parametrize(("domain", "dims"), [("traffic", 1), ("crowd", 2)])
def test_only_nearest_pairs_are_listed_if_there_are_many(
    monkeypatch: pytest.MonkeyPatch, domain: Domain, dims: int
) -> None:
    def overlaps() -> list[tuple[int, ...]]:
        s = paths(np.ones((3, 40, dims)) * np.arange(3)[:, None, None], 0.2)
        return [f.agents for f in find_faults(s, domain) if f.kind == "overlap"]

    assert len(overlaps()) == 40 * 39 / 2
    monkeypatch.setattr(quality, "PAIRS", 1000)
    nearest = overlaps()
    assert {i for agents in nearest for i in agents} == set(range(40))
    assert len(nearest) <= 2 * 40 * 3


def test_positions_whose_squares_overflow() -> None:
    s = lane([[0.0, 10.0, 1e300], [1.0, 1e308, -1e308], [2.0, 12.0, 1e300]])
    with np.errstate(all="ignore"):
        assert "jump" in kinds(s)
