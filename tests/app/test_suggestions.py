"""Commands and Python code that ``nnode check`` prints run unchanged, for tables of many forms."""

from __future__ import annotations

import shlex
from collections.abc import Callable
from pathlib import Path

import pandas as pd
import pytest

import nnode
from nnode.data.store import Store
from tests.app.conftest import Script
from tests.data.check.planted import cars, people, saved, text


def platoons(number: int = 5, seconds: float = 12.0) -> pd.DataFrame:
    """Platoons in each of which vehicles and times are numbered from 0."""
    parts = [
        cars(3, seconds).assign(platoon=k, x=lambda d, k=k: d.x + 3 * k) for k in range(number)
    ]
    table = pd.concat(parts, ignore_index=True).rename(columns={"veh": "car", "x": "pos"})
    return table[["platoon", "t", "car", "pos"]]


def tidy(folder: Path) -> Path:
    names = {"platoon": "sequence", "t": "time", "car": "agent", "pos": "x"}
    return saved(platoons().rename(columns=names), folder)


def of_platoons(folder: Path) -> Path:
    return saved(platoons(), folder, "my platoons.csv")


def in_feet(folder: Path) -> Path:
    table = platoons().assign(pos=lambda d: d.pos / 0.3048, t=lambda d: (1000 * d.t).round())
    return saved(table.rename(columns={"pos": "pos [ft]", "t": "t [ms]"}), folder)


def with_semicolons(folder: Path) -> Path:
    path = folder / "german.csv"
    platoons().to_csv(path, index=False, sep=";", decimal=",")
    return path


def vehicles(folder: Path) -> Path:
    table = cars().assign(v=lambda d: 3.6 * d.v, frame=lambda d: (10 * d.t).round().astype(int))
    return saved(table.drop(columns="t"), folder)


def recordings(folder: Path) -> Path:
    """Vehicles that enter and leave in two runs with the same identifiers and times."""
    parts = [cars(6).query(f"{k} <= t - 2*veh <= 25").assign(run=k) for k in (1, 2)]
    return saved(pd.concat(parts).drop(columns="lane"), folder)


def pairs(folder: Path) -> Path:
    table = cars(2)
    lead, follow = (table[table.veh == i].reset_index() for i in (0, 1))
    columns = {
        "t_ms": 1000 * lead.t,
        "xFollower": follow.x,
        "x_leader": lead.x,
        "v_follower": follow.v,
        "v_leader": lead.v,
    }
    return saved(pd.DataFrame(columns), folder, "pairs.csv")


def crowd(folder: Path) -> Path:
    return saved(people(12).drop(columns=["vx", "vy"]).rename(columns={"id": "ped"}), folder)


def crowd_of_runs(folder: Path) -> Path:
    parts = [people(8).assign(run=k) for k in "ab"]
    return saved(pd.concat(parts).drop(columns=["vx", "vy"]), folder)


def pedpy(folder: Path) -> Path:
    return text(people(12), folder, "# framerate: 16 fps\n# id frame x/cm y/cm z/cm\n", 100.0)


Form = Callable[[Path], Path]
#: Tables and their numbers of sequences.
FORMS: list[tuple[Form, int | None]] = [
    (tidy, 5),
    (of_platoons, 5),
    (in_feet, 5),
    (with_semicolons, 5),
    (vehicles, 1),
    (recordings, None),
    (pairs, 1),
    (crowd, None),
    (crowd_of_runs, None),
    (pedpy, None),
]


def commands(printed: str) -> list[list[str]]:
    """The printed commands, as lists of words."""
    lines = [line.strip() for line in printed.splitlines()]
    return [shlex.split(line)[1:] for line in lines if line.startswith("nnode ")]


def python(printed: str) -> str:
    """The printed Python code."""
    code = printed.partition("in Python:\n")[2].splitlines()
    return "\n".join(line.removeprefix("  ") for line in code if not line.startswith("page: "))


@pytest.mark.thorough
@pytest.mark.parametrize(("form", "number"), FORMS)
def test_printed_commands_and_python_run(
    script: Script, tmp_path: Path, form: Form, number: int | None
) -> None:
    path = form(tmp_path)
    done = script("check", str(path), folder=tmp_path / "check")
    assert "refuses it" not in done.stdout
    lines = python(done.stdout)
    (prepare, train, *_) = commands(done.stdout)
    assert (prepare[0], train[0]) == ("prepare_data", "train")
    for name, *words in (prepare, train):
        script(name, *words, folder=tmp_path / name)
    read = lines.splitlines()[-2]
    variables: dict[str, nnode.Sequences] = {}
    exec(compile(f"import nnode\n{read}", "read", "exec"), variables)
    store = Store(tmp_path / "prepare_data")
    assert [s.name for s in variables["data"]] == [entry["name"] for entry in store.index]
    assert number in (None, len(store))
    exec(compile(lines.replace("nnode.fit(", "nnode.fit(epochs=2, data="), "fit", "exec"), {})


@pytest.mark.thorough
@pytest.mark.parametrize("form", [of_platoons, with_semicolons, pedpy])
def test_printed_diagnosis_runs(script: Script, tmp_path: Path, form: Form) -> None:
    done = script("check", str(form(tmp_path)), folder=tmp_path / "check")
    (words,) = [line for name, *line in commands(done.stdout) if name == "discover"]
    done = script("discover", *words, folder=tmp_path / "discover")
    assert "verdict: " in done.stdout


@pytest.mark.thorough
@pytest.mark.parametrize("form", [form for form, _ in FORMS if form is not pedpy])
def test_file_frame_and_printed_python_give_the_same_sequences(tmp_path: Path, form: Form) -> None:
    path = form(tmp_path)
    rate = {"frame_rate": 16.0} if form in (crowd, crowd_of_runs) else {}
    decimal = "," if form is with_semicolons else "."
    frame = pd.read_csv(path, sep=None, engine="python", decimal=decimal)
    expected = nnode.sequences(path, **rate)
    assert len(expected) > 0
    variables: dict[str, nnode.Sequences] = {}
    code = "\n".join(nnode.check(path, frame_rate=rate.get("frame_rate")).python[:2])
    exec(compile(code, "printed", "exec"), variables)
    for sequences in (nnode.sequences(frame, **rate), variables["data"]):
        for a, b in zip(sequences, expected, strict=True):
            assert a.x == pytest.approx(b.x, abs=1e-9)


def test_prepare_data_recognises_columns_and_units(script: Script, tmp_path: Path) -> None:
    for form in (in_feet, of_platoons):
        path = form(tmp_path)
        run = tmp_path / form.__name__
        words = ["data=table", f"data.path={path}", f"hydra.run.dir={run}"]
        done = script("prepare_data", *words, "data.domain=traffic")
        assert "recognised agent = car, time = t" in done.stdout
        for prepared, expected in zip(Store(run), nnode.sequences(platoons()), strict=True):
            assert prepared.x == pytest.approx(expected.x, abs=1e-9)
    words = ["data=vehicles", f"data.path={path}", f"hydra.run.dir={tmp_path / 'refused'}"]
    done = script("prepare_data", *words, status=2)
    assert "has no columns of data=vehicles; nnode check" in done.stderr
