"""SUMO's floating car data: lanes, time steps, compressed and invalid files."""

from __future__ import annotations

import gzip
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from nnode.data.options import Faults
from nnode.data.prepare import prepare
from nnode.data.readers.sumo import SumoOptions, sumo_files
from nnode.errors import ConfigError, DataError, NNodeError
from tests.data import tables
from tests.data.tables import damaged

HEAD = '<?xml version="1.0" encoding="UTF-8"?>\n<!-- by SUMO -->\n<fcd-export>\n'


def car(name: str, pos: float, lane: str = "e_0", attributes: str = "") -> str:
    return (
        f'<vehicle id="{name}" x="0" y="0" type="car" speed="10.00" pos="{pos}" lane="{lane}"'
        f"{attributes}/>\n"
    )


def step(time: object, *elements: str) -> str:
    return f'<timestep time="{time}">\n{"".join(elements)}</timestep>\n'


def steps(n: int = 11, dt: float = 0.2, attributes: str = "", lane: str = "e_0") -> list[str]:
    """Three cars at 10 m/s on one lane, and a person next to the last car."""
    starts = {"a": 90, "b": 50, "c": 0}
    person = '<person id="p" x="1" y="1" speed="1" pos="2" edge="e"/>\n'
    return [
        step(
            f"{dt * k:.2f}",
            *(car(name, x0 + 10 * dt * k, lane, attributes) for name, x0 in starts.items()),
            person,
        )
        for k in range(n)
    ]


def write(path: Path, *elements: str) -> Path:
    path.write_text(HEAD + "".join(elements) + "</fcd-export>\n")
    return path


read = partial(tables.read, SumoOptions)


def test_a_platoon(tmp_path: Path) -> None:
    (s,) = read(write(tmp_path / "fcd.xml", *steps()))
    assert (s.name, s.agents, s.kind) == ("fcd_e_0/000", ("c", "b", "a"), ("car",) * 3)
    np.testing.assert_allclose(s.time, 0.2 * np.arange(11), atol=1e-12)
    np.testing.assert_allclose(s.x[:, :, 0], 10 * s.time[:, None] + [0, 50, 90])
    np.testing.assert_allclose(s.v, 10.0)
    assert s.length is None


def test_lengths_and_kinds(tmp_path: Path) -> None:
    path = write(tmp_path / "fcd.xml", *steps(attributes=' length="4.5"'))
    (s,) = read(path, kinds={"car": "passenger car"})
    assert s.kind == ("passenger car",) * 3
    np.testing.assert_array_equal(s.length, [4.5] * 3)


@pytest.mark.parametrize("name", ["fcd.xml.gz", "fcd.xml"])
def test_compressed_files_are_recognised_by_content(tmp_path: Path, name: str) -> None:
    plain = write(tmp_path / "plain.xml", *steps())
    path = tmp_path / name
    path.write_bytes(gzip.compress(plain.read_bytes()))
    assert list(sumo_files(SumoOptions(path=str(path)))) == ["fcd"]
    (s,), (expected,) = read(path), read(plain)
    np.testing.assert_array_equal(s.x, expected.x)
    assert s.recording == "fcd_e_0"


def test_new_edge_divides_a_platoon(tmp_path: Path) -> None:
    later = [
        step(
            f"{2.2 + 0.2 * k:.2f}",
            car("a", 2 * k, "f_0"),
            car("b", 72 + 2 * k),
            car("c", 22 + 2 * k),
        )
        for k in range(5)
    ]
    first, second = read(write(tmp_path / "fcd.xml", *steps(), *later), min_vehicles=2)
    assert (first.agents, second.agents) == (("c", "b", "a"), ("c", "b"))
    assert second.time[0] == pytest.approx(2.2)


def test_lanes_within_junctions_are_read_by_name(tmp_path: Path) -> None:
    path = write(tmp_path / "fcd.xml", *steps(lane=":J_0_0"))
    with pytest.raises(DataError, match=r"all vehicles are on lanes within junctions.*data\.lane"):
        read(path)
    (s,) = read(path, lane=":J_0_0")
    assert s.n_agents == 3
    with pytest.raises(ConfigError, match="has the lanes :J_0_0"):
        read(path, lane="e_1")


def test_prepare(tmp_path: Path) -> None:
    path = write(tmp_path / "fcd.xml", *steps())
    store = prepare(SumoOptions(path=str(path), faults=Faults.error), tmp_path / "out")
    assert (len(store), store.dims, store.manifest["dt"]) == (1, 1, 0.2)


def test_grid_finer_than_the_file_is_refused(tmp_path: Path) -> None:
    path = write(tmp_path / "fcd.xml", *steps(dt=1.0))
    with pytest.raises(ConfigError, match=r"data\.dt=1,"):
        read(path)
    (s,) = read(path, dt=1.0)
    assert s.n_samples == 11


ENTITIES = (
    '<!DOCTYPE fcd-export [<!ENTITY a "aaaaaaaaaa"><!ENTITY b "&a;&a;&a;&a;&a;&a;&a;&a;">]>\n'
    '<fcd-export><timestep time="0"><vehicle id="&b;" pos="1" lane="e_0"/></timestep></fcd-export>'
)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "line 1.*no element found"),
        ("vehicle,time,x\n", "line 1.*no whole XML document"),
        (HEAD + "".join(steps()), "line 70.*still have been writing"),
        ("<netstate/>", "line 1.*<fcd-export>.*<netstate>"),
        (HEAD + "</fcd-export>", "no vehicle"),
        (HEAD + car("a", 1) + "</fcd-export>", "line 4.*outside <timestep>"),
        (HEAD + step("0:00:01", car("a", 1)), "line 4.*'0:00:01'.*human-readable-time"),
        (HEAD + step(0, car("a", 1).replace("pos", "posLat")), "line 5.*pos.*no such"),
        (HEAD + step(0, car("a", float("nan"))), "line 5.*'nan'"),
        (HEAD + step(0, car("a", 1).replace("lane=", "edge=")), "line 5.*'lane'"),
        (
            HEAD + step(0, car("a", 1), car("a", 2)) + "</fcd-export>",
            "line 6.*second time.*line 5",
        ),
        (ENTITIES, "line 1.*document type declaration"),
        ('<!DOCTYPE x SYSTEM "file:///etc/passwd"><fcd-export/>', "document type declaration"),
    ],
)
def test_invalid_files(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "fcd.xml"
    path.write_text(text)
    with pytest.raises(DataError, match=f"(?s){message}") as error:
        read(path)
    assert str(path) in str(error.value)


def test_incomplete_gzip_file(tmp_path: Path) -> None:
    content = gzip.compress(write(tmp_path / "plain.xml", *steps()).read_bytes())
    path = tmp_path / "fcd.xml.gz"
    path.write_bytes(content[: len(content) // 2])
    with pytest.raises(DataError, match=r"fcd\.xml\.gz cannot be read"):
        read(path)


@given(st.data())
@settings(
    max_examples=80, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
def test_damaged_file_is_read_or_refused(tmp_path: Path, data: st.DataObject) -> None:
    content = write(tmp_path / "valid.xml", *steps()).read_bytes()
    content = gzip.compress(content) if data.draw(st.booleans()) else content
    path = tmp_path / "damaged.xml"
    path.write_bytes(damaged(data, content, 0, 16))
    try:
        result = read(path)
    except NNodeError:
        return
    assert all(np.isfinite(s.x).all() for s in result)
