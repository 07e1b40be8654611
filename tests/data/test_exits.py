"""Destinations from exit lines: whose exit, and which point of it."""

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

ENDS = {
    "right": {"line": [6, 0, 6, 4], "direction": "+x"},
    "left": {"line": [-6, 0, -6, 4], "direction": "-x"},
}


def test_nearest_points_of_a_line() -> None:
    (door,) = read_exits({"door": {"line": [2, 0, 4, 2]}})
    x = np.array([[0.0, 0.0], [3.0, 0.0], [9.0, 5.0], [2.0, 4.0]])
    expected = [[2, 0], [2.5, 0.5], [4, 2], [4, 2]]
    np.testing.assert_allclose([door.point(place) for place in x], expected)
    # no point of the line is nearer
    points = np.linspace([2, 0], [4, 2], 1001)
    for place, point in zip(x, expected, strict=True):
        nearest = points[np.linalg.norm(points - place, axis=1).argmin()]
        np.testing.assert_allclose(point, nearest, atol=2e-3)


def test_whose_exit() -> None:
    told = {
        **ENDS,
        "up": {"line": [0, 9, 1, 9], "direction": "+x", "group": "band"},
        "ahead": {"heading": [3, 4], "group": "crew"},
    }
    exits = read_exits(told)
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
    with pytest.raises(
        DataError,
        match=r"t\.csv: no exit .* is for person d of group 'crew', who goes from \(0\.0, 0\.0\) m",
    ):
        list(exits_of(exits[:1], people, rows[3:]))
    # without direction the nearest to where people are last seen
    assert names(read_exits({name: {"line": end["line"]} for name, end in ENDS.items()})) == [
        "right",
        "left",
        "right",
        "left",
    ]


@pytest.mark.parametrize(
    ("told", "said"),
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
def test_exits_that_are_none(told: dict[str, object], said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        read_exits(told)


def test_people_of_a_text_file(tmp_path: Path) -> None:
    rows = [f"1 {k} {-100 + 4 * k} 100 0\n" for k in range(51)]
    # person 2 stands for the first second before going left
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
    parts = [
        pd.DataFrame(
            {
                "sequence": 1,
                "time": 0.1 * k,
                "agent": name,
                "x": sign * 0.1 * k,
                "y": y,
                "group": group,
            }
        )
        for name, sign, y, group in (("a", 1, 2.0, ""), ("b", -1, 2.5, ""), ("c", 1, 1.0, "band"))
    ]
    path = tmp_path / "t.csv"
    pd.concat(parts).to_csv(path, index=False)
    exits = {**ENDS, "stage": {"line": [0, 3, 2, 3], "group": "band"}}
    options = TableOptions(domain="crowd", path=str(path), exits=exits)
    store = prepare(options, tmp_path / "store")
    expected = [[6, 2], [-6, 2.5], [0, 3]]
    np.testing.assert_allclose(store[0].destination, expected)
    np.testing.assert_allclose(collate(store).destination[0], expected)
    pd.concat(parts).assign(dest_x=0.0, dest_y=0.0).to_csv(path, index=False)
    with pytest.raises(ConfigError, match="without the columns dest_x"):
        read_table(path, options)


@pytest.mark.real
def test_the_corridor_has_an_exit_at_each_end(real_data: Path) -> None:
    path = real_data / "juelich" / "bi_corr_400_b_03.txt"
    result = read_juelich(path, JuelichOptions(exits=ENDS))
    for s in result:
        assert s.destination is not None
        assert set(s.destination[:, 0]) <= {-6.0, 6.0}
        assert ((s.destination[:, 1] >= 0) & (s.destination[:, 1] <= 4)).all()
    # nearly everybody who moves does so towards his exit
    towards = np.concatenate(
        [
            (s.x[-1, :, 0] - s.x[0, :, 0]) * (s.destination[:, 0] - s.x[0, :, 0])
            for s in result
            if s.destination is not None
        ]
    )
    assert (towards > 0).mean() > 0.97
