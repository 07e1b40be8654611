"""What a check prints runs as it stands: commands and lines of Python, on tables of many forms."""

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
    """Platoons whose vehicles and times are numbered anew in each."""
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
    table = platoons().assign(pos=lambda d: d.pos / 0.3048)
    return saved(
        table.rename(columns={"pos": "pos [ft]", "t": "t [ms]"}).assign(
            **{"t [ms]": lambda d: (1000 * d["t [ms]"]).round()}
        ),
        folder,
    )


def with_semicolons(folder: Path) -> Path:
    path = folder / "german.csv"
    platoons().to_csv(path, index=False, sep=";", decimal=",")
    return path


def vehicles(folder: Path) -> Path:
    table = cars().assign(v=lambda d: 3.6 * d.v, frame=lambda d: (10 * d.t).round().astype(int))
    return saved(table.drop(columns="t"), folder)


def recordings(folder: Path) -> Path:
    """Vehicles that come and go, in two runs whose identifiers and times begin anew."""
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
#: Tables, with the number of sequences that each is.
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
#: Those that every run of the tests takes; the others take half a minute each.
QUICK = ("of_platoons", "recordings", "pairs")
CASES = [
    pytest.param(
        form,
        number,
        id=form.__name__,
        marks=[] if form.__name__ in QUICK else [pytest.mark.thorough],
    )
    for form, number in FORMS
]


def commands(printed: str) -> list[list[str]]:
    """The commands that a check printed."""
    lines = [line.strip() for line in printed.splitlines()]
    return [shlex.split(line)[1:] for line in lines if line.startswith("nnode ")]


def python(printed: str) -> str:
    """The Python that a check printed."""
    lines = printed.splitlines()
    rest = lines[lines.index("in Python:") + 1 :]
    return "\n".join(one.removeprefix("  ") for one in rest if not one.startswith("page: "))


@pytest.mark.thorough
@pytest.mark.parametrize(("form", "number"), CASES)
def test_commands_and_python_that_are_printed_run(
    script: Script, tmp_path: Path, form: Form, number: int | None
) -> None:
    path = form(tmp_path)
    done = script("check", str(path), f"hydra.run.dir={tmp_path / 'check'}")
    assert "refuses it" not in done.stdout
    lines = python(done.stdout)
    (prepare, train, *_) = commands(done.stdout)
    assert (prepare[0], train[0]) == ("prepare_data", "train")
    for name, *words in (prepare, train):
        script(name, *words, f"hydra.run.dir={tmp_path / name}")
    read = lines.splitlines()[-2]
    held: dict[str, nnode.Sequences] = {}
    exec(compile(f"import nnode\n{read}", "read", "exec"), held)
    store = Store(tmp_path / "prepare_data")
    assert [s.name for s in held["data"]] == [entry["name"] for entry in store.index]
    assert number in (None, len(store))
    exec(compile(lines.replace("nnode.fit(", "nnode.fit(epochs=2, data="), "fit", "exec"), {})


@pytest.mark.thorough
@pytest.mark.parametrize("form", [of_platoons, with_semicolons, pedpy])
def test_the_diagnosis_that_is_printed_runs(script: Script, tmp_path: Path, form: Form) -> None:
    done = script("check", str(form(tmp_path)), f"hydra.run.dir={tmp_path / 'check'}")
    (words,) = [line for name, *line in commands(done.stdout) if name == "discover"]
    ran = script("discover", *words, f"hydra.run.dir={tmp_path / 'discover'}")
    assert "verdict: " in ran.stdout


@pytest.mark.thorough
def test_what_is_told_in_python_reads_what_is_recognised(tmp_path: Path) -> None:
    """A table is recognised alike in a file and in memory, and by what a check tells."""
    for form, _ in FORMS:
        if form is pedpy:
            continue
        folder = tmp_path / form.__name__
        folder.mkdir()
        path = form(folder)
        rate = {"frame_rate": 16.0} if form in (crowd, crowd_of_runs) else {}
        frame = nnode.sequences(
            pd.read_csv(
                path, sep=None, engine="python", decimal=("," if form is with_semicolons else ".")
            ),
            **rate,
        )
        file = nnode.sequences(path, **rate)
        assert len(frame) == len(file) > 0
        for a, b in zip(frame, file, strict=True):
            assert a.x == pytest.approx(b.x, abs=1e-9)
        result = nnode.check(path, frame_rate=rate.get("frame_rate"))
        told: dict[str, nnode.Sequences] = {}
        exec(compile("\n".join(result.python[:2]), "told", "exec"), told)
        for a, b in zip(told["data"], file, strict=True):
            assert a.x == pytest.approx(b.x, abs=1e-9)


def test_a_command_recognises_columns_and_units(script: Script, tmp_path: Path) -> None:
    for form in (of_platoons, in_feet):
        path = form(tmp_path)
        run = tmp_path / form.__name__
        words = ["data=table", f"data.path={path}", f"hydra.run.dir={run}"]
        done = script("prepare_data", *words, "data.domain=traffic")
        assert "recognised agent = car, time = t" in done.stdout
        for ours, theirs in zip(Store(run), nnode.sequences(platoons()), strict=True):
            assert ours.x == pytest.approx(theirs.x, abs=1e-9)
    done = script(
        "prepare_data",
        "data=vehicles",
        f"data.path={of_platoons(tmp_path)}",
        f"hydra.run.dir={tmp_path / 'no'}",
        status=2,
    )
    assert "has no columns of data=vehicles; nnode check" in done.stderr
