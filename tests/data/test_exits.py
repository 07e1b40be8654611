"""Destinations from exit lines: the exit of a person, and its nearest point."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from nnode.data.exits import FAR, Exit, exits_of, read_exits
from nnode.data.prepare import prepare
from nnode.data.readers.juelich import JuelichOptions, read_juelich
from nnode.data.readers.table import TableOptions, read_table
from nnode.data.sequence import collate
from nnode.data.trajectories import Trajectories
from nnode.errors import ConfigError, DataError
from tests.data.tables import saved

ENDS = {
    "right": {"line": [6, 0, 6, 4], "direction": "+x"},
    "left": {"line": [-6, 0, -6, 4], "direction": "-x"},
}


def test_nearest_points_of_a_line() -> None:
    (door,) = read_exits({"door": {"line": [2, 0, 4, 2]}})
    places = np.array([[0.0, 0.0], [3.0, 0.0], [9.0, 5.0], [2.0, 4.0]])
    expected = [[2, 0], [2.5, 0.5], [4, 2], [4, 2]]
    np.testing.assert_allclose([door.point(place) for place in places], expected)
    # no point of the line is nearer
    points = np.linspace([2, 0], [4, 2], 1001)
    distance = np.linalg.norm(points - places[:, None], axis=-1)
    np.testing.assert_allclose(points[distance.argmin(axis=1)], expected, atol=2e-3)


def test_exit_of_each_person() -> None:
    exits = read_exits(
        {
            **ENDS,
            "up": {"line": [0, 9, 1, 9], "direction": "+x", "group": "band"},
            "ahead": {"heading": [3, 4], "group": "crew"},
        }
    )
    people = Trajectories(
        path=Path("t.csv"),
        name="t",
        where=str,
        agent=np.repeat(np.array(list("abcd"), dtype=object), 2),
        time=np.tile([0.0, 1.0], 4),
        x=np.array([[0, 0], [3, 1], [0, 0], [-0.1, 3], [0, 0], [1, 8], [0, 0], [-2.0, 0]]),
        group=np.repeat(np.array(["", "", "band", "crew"], dtype=object), 2),
    )
    rows = [np.array([2 * i, 2 * i + 1]) for i in range(4)]

    def names(exits: list[Exit]) -> list[str]:
        return [exit_.name for _, exit_ in exits_of(exits, people, rows)]

    assert names(exits) == ["right", "left", "up", "ahead"]
    heading = exits[3].point(np.array([1.0, 1.0]))
    np.testing.assert_allclose(heading, [1 + 0.6 * FAR, 1 + 0.8 * FAR])
    message = r"t\.csv: no exit .* is for person d of group 'crew', who goes from \(0\.0, 0\.0\) m"
    with pytest.raises(DataError, match=message):
        list(exits_of(exits[:1], people, rows[3:]))
    # without a direction: the exit nearest to a person's last position
    lines = {name: {"line": end["line"]} for name, end in ENDS.items()}
    assert names(read_exits(lines)) == ["right", "left", "right", "left"]


@pytest.mark.parametrize(
    ("exits", "message"),
    [
        ({"a": {"line": [1, 2, 3]}}, r"a\.line=\[1, 2, 3\]: expected 4 numbers"),
        ({"a": {"line": [1, 2, 1, 2]}}, "ends where it begins"),
        ({"a": {"direction": "+x"}}, "expected a line or a heading"),
        ({"a": {"line": [0, 0, 1, 1], "heading": "+x"}}, "expected a line or a heading"),
        ({"a": {"heading": "up"}}, r"heading=up: expected \[x, y\] or one of \+x"),
        ({"a": {"heading": [0, 0]}}, "not zero"),
        ({"a": {"colour": 1}}, "expected some of line, heading, direction, group"),
        ({"a": 5}, "expected some of"),
    ],
)
def test_invalid_exits(exits: dict[str, object], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        read_exits(exits)


def test_people_of_a_text_file(tmp_path: Path) -> None:
    rows = [f"1 {k} {-100 + 4 * k} 100 0\n" for k in range(51)]
    # person 2 stands still for one second and then walks to the left
    rows += [f"2 {k} {100 - 4 * max(k - 25, 0)} 300 0\n" for k in range(51)]
    path = tmp_path / "run.txt"
    path.write_text("# framerate: 25 fps\n# id frame x/cm y/cm z/cm\n" + "".join(rows))
    first, second = read_juelich(path, JuelichOptions(exits=ENDS))
    for s in (first, second):
        np.testing.assert_allclose(s.destination, [[6, 1], [-6, 3]])
    plain = read_juelich(path, JuelichOptions())[0]
    np.testing.assert_allclose(plain.destination, plain.x[-1])
    with pytest.raises(DataError, match=r"run\.txt: no exit .* is for person 2"):
        read_juelich(path, JuelichOptions(exits={"right": ENDS["right"]}))


def test_people_of_a_table(tmp_path: Path) -> None:
    k = np.arange(5)
    table = pd.concat(
        pd.DataFrame({"time": 0.1 * k, "agent": agent, "x": v * k, "y": y, "group": group})
        for agent, v, y, group in (("a", 0.1, 2, ""), ("b", -0.1, 2.5, ""), ("c", 0.1, 1, "band"))
    ).assign(sequence=1)
    path = saved(tmp_path / "t.csv", table)
    exits = {**ENDS, "stage": {"line": [0, 3, 2, 3], "group": "band"}}
    options = TableOptions(domain="crowd", path=str(path), exits=exits)
    store = prepare(options, tmp_path / "store")
    expected = [[6, 2], [-6, 2.5], [0, 3]]
    np.testing.assert_allclose(store[0].destination, expected)
    np.testing.assert_allclose(collate(store).destination[0], expected)
    saved(path, table.assign(dest_x=0.0, dest_y=0.0))
    with pytest.raises(ConfigError, match="without the columns dest_x"):
        read_table(path, options)


@pytest.mark.real
def test_real_corridor(real_data: Path) -> None:
    path = real_data / "juelich" / "bi_corr_400_b_03.txt"
    result = read_juelich(path, JuelichOptions(exits=ENDS))
    destination = np.concatenate([s.destination for s in result])
    assert set(destination[:, 0]) <= {-6.0, 6.0}
    assert ((destination[:, 1] >= 0) & (destination[:, 1] <= 4)).all()
    # nearly all people move towards their exit
    first, last = (np.concatenate([s.x[k, :, 0] for s in result]) for k in (0, -1))
    assert ((last - first) * (destination[:, 0] - first) > 0).mean() > 0.97
