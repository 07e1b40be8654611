"""``nnode check`` and ``nnode.check``: the printed summary, the page, and the options."""

from __future__ import annotations

import shlex
from pathlib import Path

import pytest

import nnode
from nnode.data.store import Store
from nnode.errors import ConfigError
from tests.app.conftest import Script
from tests.data.check.planted import cars, people, saved, text


@pytest.mark.thorough
def test_printed_command_reads_the_file(script: Script, tmp_path: Path) -> None:
    table = cars()
    table["t"] = (1000 * table["t"]).round().astype(int)
    table["x"] /= -0.3048
    table["length"] /= 0.3048
    file = saved(table.rename(columns={"veh": "Vehicle ID"}), tmp_path, "my cars.csv")
    done = script("check", str(file), folder=tmp_path / "run")
    assert "12 vehicles, 4812 positions, sampled every 0.1 s: 0 errors and 1 warning" in done.stdout
    assert "WARN  direction: all vehicles drive towards smaller positions" in done.stdout
    page = (tmp_path / "run" / "check.html").read_text(encoding="utf-8")
    assert "Check of my cars.csv" in page
    (line,) = [line for line in done.stdout.splitlines() if "nnode prepare_data" in line]
    words = shlex.split(line)[2:]
    script("prepare_data", *words, folder=tmp_path / "data")
    options = Store(tmp_path / "data").manifest["options"]
    assert (options["position_unit"], options["time_unit"]) == ("ft", "ms")
    assert options["direction"] == -1
    assert options["columns"]["vehicle"] == "Vehicle ID"


@pytest.fixture
def pedpy(tmp_path: Path) -> Path:
    """People in the format of PedPy, in cm."""
    return text(people(), tmp_path, "# framerate: 16 fps\n# id frame x/cm y/cm z/cm\n", 100.0)


def test_check_in_python(pedpy: Path, tmp_path: Path) -> None:
    result = nnode.check(pedpy)
    assert isinstance(result, nnode.Check)
    assert result.sentence.startswith("40 people, ")
    assert result.options == ["data=pedpy", f"data.path={pedpy}"]
    assert result.probability > 0.99
    assert result.write(tmp_path / "page").name == "check.html"
    text, html = repr(result), result._repr_html_()
    assert text.splitlines()[0] == f"{pedpy}: {result.sentence}"
    assert "columns: agent = column 1, frame = column 2, x = column 3, y = column 4" in text
    assert "units: crowd, positions in cm, times in frames of 1/16 s (sure)" in text
    assert f"\n  nnode prepare_data data=pedpy data.path={pedpy}\n" in text
    assert f"<p>{result.sentence}</p>" in html
    for finding in result.findings:
        assert finding.text in text
        assert finding.kind in html
    with pytest.raises(ConfigError, match="domain=sea: expected traffic, crowd, or null"):
        nnode.check(pedpy, "sea")  # type: ignore[arg-type]
