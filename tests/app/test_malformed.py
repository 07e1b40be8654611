"""Malformed inputs: one clear error each, no traceback, and an exit status that says so."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from tests.app.conftest import Script

HEAD = "vehicle,time,x\n"
ROWS = "".join(f"{v},{0.2 * k:.1f},{30 * v + 5 * k}\n" for v in range(4) for k in range(6))
TABLE = "sequence,time,agent,x\n"

VEHICLES = ("data=vehicles", "data.columns={vehicle: vehicle, time: time, x: x}")
Make = Callable[[Path, Path], list[str]]


def _file(text: str, *options: str) -> Make:
    def make(folder: Path, raw: Path) -> list[str]:
        path = folder / "cars.csv"
        path.write_text(text)
        return [*(options or VEHICLES), f"data.path={path}"]

    return make


def _demo(*options: str) -> Make:
    return lambda folder, raw: ["data=demo_traffic", f"data.source={raw}", *options]


def _truncated(folder: Path, raw: Path) -> list[str]:
    (folder / "esimas").mkdir()
    whole = (raw / "esimas" / "sequence_datademo.mat").read_bytes()
    (folder / "esimas" / "sequence_datademo.mat").write_bytes(whole[: len(whole) // 2])
    return ["data=demo_traffic", f"data.source={folder}"]


CASES = {
    "wrong columns": (_file("car,when,where\n1,0,0\n"), ["cars.csv", "vehicle"]),
    "text in a number": (_file(HEAD + ROWS + "3,1.2,far\n"), ["cars.csv", "26", "far"]),
    "empty file": (_file(""), ["cars.csv", "empty"]),
    "truncated mat": (_truncated, ["sequence_datademo.mat"]),
    "one vehicle": (_file(HEAD + "".join(f"1,{0.2 * k:.1f},{k}\n" for k in range(9))), ["vehicle"]),
    "NaN": (
        _file(
            TABLE + "a,0,1,0\na,0,2,9\na,1,1,nan\na,1,2,19\na,2,1,9\na,2,2,29\n",
            "data=table",
            "data.domain=traffic",
        ),
        [],
    ),
    "unknown recording": (_demo("data.recording=demo2"), ["demo2"]),
    "dt that does not divide": (_demo("solver.dt=0.003"), ["solver.dt", "0.2 s"]),
}


@pytest.mark.parametrize("case", CASES)
def test_one_clear_error(script: Script, raw: Path, tmp_path: Path, case: str) -> None:
    make, words = CASES[case]
    run = tmp_path / "run"
    done = script("train", *make(tmp_path, raw), f"hydra.run.dir={run}", status=None)
    assert done.returncode != 0
    assert "Traceback" not in done.stderr
    errors = [line for line in done.stderr.splitlines() if line.startswith("error: ")]
    assert len(errors) == 1, done.stderr
    for word in words:
        assert word in errors[0]
    assert not (run / "checkpoints").exists()
