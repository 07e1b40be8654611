"""Safe file names, and interpolations in the content of files."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from nnode.files import file_name, interpolation

SAFE = ["sf", "n4", "sf_1-1_1_seed 3", "a.b", "sf'", "größe", "1,5 m"]


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        *zip(SAFE, SAFE, strict=True),
        ("../../escaped", "__.._escaped"),
        ("/etc/passwd", "_etc_passwd"),
        ("..", "_"),
        ("", "_"),
        ("a\\b", "a_b"),
        ("C:x", "C_x"),
        (".hidden", "_hidden"),
        ("a\0b\n", "a_b_"),
        ("a" * 300, "a" * 100),
    ],
)
def test_path_characters_are_replaced(name: str, expected: str) -> None:
    assert file_name(name) == expected


@given(st.text(max_size=300))
def test_any_name_stays_in_the_folder(name: str) -> None:
    path = Path("/run/folder") / f"{file_name(name)}.png"
    assert path.parent == Path("/run/folder")
    assert path.resolve() == path
    assert len(path.stem) <= 100


def test_nested_interpolations_are_found() -> None:
    for content in ("${a}", ["b", ("${a}",)], {"b": {"c": "${a}"}}, {"${a}": 1}, [{"x": ["${a}"]}]):
        assert interpolation(content) == "${a}"
    assert interpolation({"a": ["$", "{a}", 1, None, 2.5, {"b": "$ {a}"}]}) is None


def test_endless_content_is_refused() -> None:
    endless: list[object] = []
    endless.append(endless)
    with pytest.raises(ValueError, match="nested more than"):
        interpolation(endless)
    with pytest.raises(ValueError, match="more than 10 values"):
        interpolation([list(range(20))], 10)
