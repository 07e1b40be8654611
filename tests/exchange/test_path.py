"""The README's commands from a table to SUMO, run with the installed wheel."""

from __future__ import annotations

import gzip
import re
import shlex
import time
from importlib.util import find_spec
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pandas as pd
import pytest

from benchmarks.programs.sumo import network
from nnode.model.effects.lane import SpeedZone
from tests.app.conftest import read_json
from tests.app.following import LENGTH, STEP, TRUE, idm
from tests.app.test_replay import page_data, tracks
from tests.installed import ROOT, Run, built, installed

#: Zone (m), and the factor of the desired speed within.
ZONE, FACTOR = (400.0, 550.0), 0.55
#: Width of the edges of the effect speed_zone (m).
EDGE = SpeedZone.rules[1].constants["edge"][0]
#: Relative tolerance, as the zone of the table has sharp edges.
TOLERANCE = EDGE / (ZONE[1] - ZONE[0])
#: Initial position (m) and speed (m/s) of the scenario's first vehicle.
START, SPEED = 50.0, 20.0
#: Maximum total duration (s).
LIMIT = 900.0


def stepped(x: np.ndarray, v: np.ndarray, gap: np.ndarray, ahead: np.ndarray) -> np.ndarray:
    """``(N,)`` speeds of followers after a step; ``ahead`` are the leaders' speeds (m/s)."""
    inside = (x > ZONE[0]) & (x < ZONE[1])
    return np.maximum(
        v + STEP * idm(v, gap, v - ahead, TRUE["v0"] * np.where(inside, FACTOR, 1)), 0
    )


def platoons(number: int = 30, cars: int = 4, seconds: float = 30.0, seed: int = 1) -> pd.DataFrame:
    """Platoons that drive through a zone of lower desired speed; errors of 2 cm."""
    rng, rows = np.random.default_rng(seed), []
    for k in range(number):
        mean, amplitude, phase = rng.uniform(14, 22), rng.uniform(2, 5), rng.uniform(0, 6)
        x = np.cumsum([rng.uniform(0, 200), *rng.uniform(25, 45, cars - 1)])
        v = np.full(cars, mean + amplitude * np.cos(phase))
        for t in STEP * np.arange(round(seconds / STEP) + 1):
            observed = x + 0.02 * rng.standard_normal(cars)
            clock = round(100.0 * k + t, 3)
            rows += [(k, clock, f"{k}-{n}", round(observed[n], 3), LENGTH) for n in range(cars)]
            lead = mean + amplitude * np.cos(0.35 * (t + STEP) + phase)
            new = np.append(stepped(x[:-1], v[:-1], np.diff(x) - LENGTH, v[1:]), lead)
            x, v = x + STEP * (v + new) / 2, new
    return pd.DataFrame(rows, columns=["sequence", "time", "agent", "x", "length"])


def scenario(sumo: Path, folder: Path) -> None:
    """A free vehicle and three followers on a road of one lane."""
    nodes = '<node id="a" x="0" y="0"/><node id="b" x="1500" y="0"/>'
    edge = '<edge id="e" from="a" to="b" numLanes="1" speed="60"/>'
    network(sumo, folder, nodes, edge)
    cars = "".join(
        f'<vehicle id="c{i}" type="own" route="r" depart="{3 * i}" departPos="{START}" '
        f'departSpeed="{SPEED}" insertionChecks="none"/>'
        for i in range(4)
    )
    (folder / "a.rou.xml").write_text(
        f'<routes><vType id="own" length="{LENGTH}" speedDev="0"/><route id="r" edges="e"/>'
        f"{cars}</routes>"
    )
    (folder / "scenario.sumocfg").write_text(
        '<configuration><input><net-file value="a.net.xml"/><route-files value="a.rou.xml"/>'
        "</input></configuration>"
    )


def commands() -> list[list[str]]:
    """The words of the README's commands, in order."""
    page = (ROOT / "README.md").read_text(encoding="utf-8")
    (text,) = re.findall(r"^### SUMO, JuPedSim, PedPy\n.*?^```sh\n(.*?)^```", page, re.M | re.S)
    return [shlex.split(line, comments=True) for line in text.splitlines()]


@pytest.fixture(scope="module")
def work(sumo: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder in which all commands were run."""
    if find_spec("libsumo") is None:
        pytest.skip("libsumo is not installed")
    base = tmp_path_factory.mktemp("path")
    run: Run = installed(built(base / "wheel"), base, NNODE_CACHE=str(base / "cache"))
    folder = base / "work"
    platoons().to_csv(folder / "mine.csv", index=False)
    scenario(sumo, folder)
    durations = []
    for words in commands():
        start = time.perf_counter()
        done = run(*words)
        durations.append(time.perf_counter() - start)
        print(f"{durations[-1]:.1f} s: {' '.join(words)}\n{done.stdout}{done.stderr}")
        assert done.returncode == 0, done.stderr
        assert not re.search(r"\wWarning:", done.stderr)  # SUMO's warnings are allowed
        if words[1] == "check":
            # the README's next commands use the printed options
            (line,) = [row for row in done.stdout.splitlines() if "nnode prepare_data" in row]
            options = {word.replace(f"{folder}/", "") for word in shlex.split(line)[2:]}
            assert "0 errors and 1 warning" in done.stdout
            assert "noise of measured positions: 0.02 m" in done.stdout
    arguments = {words[1]: words[2:] for words in commands()}
    assert list(arguments) == ["check", "train", "discover", "evaluate", "drive"]
    assert options == {word for word in arguments["train"] if word.startswith("data")}
    assert options < set(arguments["discover"])
    assert sum(durations) < LIMIT
    return folder


pytestmark = pytest.mark.thorough


def test_file_is_checked_and_law_calibrated(work: Path) -> None:
    assert "Check of mine.csv" in (work / "runs/check/check.html").read_text(encoding="utf-8")
    summary = read_json(work / "runs/idm/result.json")["summary"]
    assert summary["cost_train"] < summary["cost_start"]
    assert summary["cost_heldout"] < summary["cost_start"]


def test_diagnosis_names_the_zone(work: Path) -> None:
    result = read_json(work / "runs/lacks/report.json")
    assert result["verdict"] == "named"
    (effect,) = result["effects"]
    assert effect["name"] == "speed_zone"
    value = {name: c["value"] for name, c in effect["coefficients"].items()}
    assert (value["a"], value["b"]) == pytest.approx(ZONE, abs=EDGE)
    assert 1 - value["alpha"] == pytest.approx(1 - FACTOR, rel=TOLERANCE)


def test_replay_page_holds_the_table(work: Path) -> None:
    page = page_data(work / "runs/errors/replay.html")
    errors = read_json(work / "runs/lacks/report.json")["confirmation_errors"]
    assert {scene["name"] for scene in page["scenes"]} == {entry["name"] for entry in errors}
    table = pd.read_csv(work / "mine.csv")
    for scene in page["scenes"]:
        rows = table[table["sequence"] == int(scene["name"].rpartition("/")[2])]
        measured = np.sort(rows.pivot(index="agent", columns="time", values="x").to_numpy(), 0)
        np.testing.assert_allclose(np.sort(tracks(scene["measured"]), 0), measured, atol=0.0051)
        (simulated,) = scene["simulated"]
        assert simulated["title"] == "idm_with_speed_zone"
        error = np.sort(tracks(simulated["x"]), 0) - measured
        assert np.sqrt((error**2).mean()) < 1.0
    (zone,) = page["zones"]
    assert zone["x"] == pytest.approx(ZONE, abs=EDGE)


def test_vehicles_in_sumo_slow_down_in_the_zone(work: Path) -> None:
    summary = read_json(work / "runs/drive/drive.json")
    assert (summary["driven"], summary["collisions"], summary["teleports"]) == (4, 0, 0)
    assert (summary["step"], summary["method"]) == (STEP, "ballistic")
    with gzip.open(work / "runs/drive/fcd.xml.gz") as file:
        vehicles = ElementTree.parse(file).iter("vehicle")
        driven = np.array([float(v.attrib["pos"]) for v in vehicles if v.attrib["id"] == "c0"])
    x, v, expected = np.array([START]), np.array([SPEED]), [START]
    while x[0] < ZONE[1] + 50:
        new = stepped(x, v, np.array([1e9]), v)
        x, v = x + STEP * (v + new) / 2, new
        expected.append(x[0])
    # time lost in the zone compared with the desired speed elsewhere (s)
    delay = [
        np.diff(np.interp(ZONE, path, STEP * np.arange(len(path))))[0]
        - (ZONE[1] - ZONE[0]) / TRUE["v0"]
        for path in (driven, np.array(expected))
    ]
    assert delay[0] == pytest.approx(delay[1], rel=TOLERANCE)
