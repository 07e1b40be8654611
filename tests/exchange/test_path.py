"""From a table of one's own to SUMO, with the wheel alone, by the README's commands."""

from __future__ import annotations

import gzip
import json
import re
import shlex
import time
from importlib.util import find_spec
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pandas as pd
import pytest

from benchmarks.programs.sumo import network
from nnode.model.effects.lane import SpeedZone
from tests.app.following import LONG, STEP, TRUE, idm
from tests.app.test_replay import held, tracks
from tests.installed import ROOT, Run, built, installed

#: From and to, m, and the desired speed in between, of that elsewhere.
ZONE, SLOWER = (400.0, 550.0), 0.55
#: Width of the edges of the catalogue's effect, m.
EDGE = SpeedZone.rules[1].constants["edge"][0]
#: The zone of the catalogue's effect begins and ends over some metres, that of the table at once:
#: lengths, and what goes with them, may differ by this share.
SHARE = EDGE / (ZONE[1] - ZONE[0])
#: Where the scenario's first vehicle begins, m, and its speed, m/s.
START, SPEED = 50.0, 20.0
#: s; what the whole may take.
LIMIT = 900.0


def stepped(x: np.ndarray, v: np.ndarray, gap: np.ndarray, ahead: np.ndarray) -> np.ndarray:
    """``(N,)`` speeds of followers after a step: ``ahead`` is the speed of who is ahead, m/s."""
    inside = (x > ZONE[0]) & (x < ZONE[1])
    return np.maximum(
        v + STEP * idm(v, gap, v - ahead, TRUE["v0"] * np.where(inside, SLOWER, 1)), 0
    )


def platoons(number: int = 30, cars: int = 4, seconds: float = 30.0, seed: int = 1) -> pd.DataFrame:
    """Platoons that drive through a zone in which everybody wants to be slower, errors of 2 cm."""
    rng, rows = np.random.default_rng(seed), []
    for k in range(number):
        mean, deep, phase = rng.uniform(14, 22), rng.uniform(2, 5), rng.uniform(0, 6)
        x = np.cumsum([rng.uniform(0, 200), *rng.uniform(25, 45, cars - 1)])
        v = np.full(cars, mean + deep * np.cos(phase))
        for t in STEP * np.arange(round(seconds / STEP) + 1):
            observed = x + 0.02 * rng.standard_normal(cars)
            clock = round(100.0 * k + t, 3)
            rows += [(k, clock, f"{k}-{n}", round(observed[n], 3), LONG) for n in range(cars)]
            lead = mean + deep * np.cos(0.35 * (t + STEP) + phase)
            new = np.append(stepped(x[:-1], v[:-1], np.diff(x) - LONG, v[1:]), lead)
            x, v = x + STEP * (v + new) / 2, new
    return pd.DataFrame(rows, columns=["sequence", "time", "agent", "x", "length"])


def scenario(sumo: Path, folder: Path) -> None:
    """A road of one lane on which a vehicle drives freely, and three behind it."""
    nodes = '<node id="a" x="0" y="0"/><node id="b" x="1500" y="0"/>'
    edge = '<edge id="e" from="a" to="b" numLanes="1" speed="60"/>'
    network(sumo, folder, nodes, edge)
    cars = "".join(
        f'<vehicle id="c{i}" type="own" route="r" depart="{3 * i}" departPos="{START}" '
        f'departSpeed="{SPEED}" insertionChecks="none"/>'
        for i in range(4)
    )
    (folder / "a.rou.xml").write_text(
        f'<routes><vType id="own" length="{LONG}" speedDev="0"/><route id="r" edges="e"/>'
        f"{cars}</routes>"
    )
    (folder / "scenario.sumocfg").write_text(
        '<configuration><input><net-file value="a.net.xml"/><route-files value="a.rou.xml"/>'
        "</input></configuration>"
    )


def commands() -> list[list[str]]:
    """The words of the README's commands, in their order."""
    page = (ROOT / "README.md").read_text(encoding="utf-8")
    (text,) = re.findall(r"^### SUMO, JuPedSim, PedPy\n.*?^```sh\n(.*?)^```", page, re.M | re.S)
    return [shlex.split(line, comments=True) for line in text.splitlines()]


@pytest.fixture(scope="module")
def work(sumo: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder in which all commands have run."""
    if find_spec("libsumo") is None:
        pytest.skip("libsumo is not installed")
    place = tmp_path_factory.mktemp("path")
    run: Run = installed(built(place / "wheel"), place, NNODE_CACHE=str(place / "cache"))
    folder = place / "work"
    platoons().to_csv(folder / "mine.csv", index=False)
    scenario(sumo, folder)
    took = []
    for words in commands():
        begun = time.perf_counter()
        done = run(*words)
        took.append(time.perf_counter() - begun)
        print(f"{took[-1]:.1f} s: {' '.join(words)}\n{done.stdout}{done.stderr}")
        assert done.returncode == 0, done.stderr
        assert not re.search(r"\wWarning:", done.stderr)  # of Python; SUMO may warn
        if words[1] == "check":
            # what check prints reads the file, and is what the README goes on with
            (line,) = [one for one in done.stdout.splitlines() if "nnode prepare_data" in one]
            told = {word.replace(f"{folder}/", "") for word in shlex.split(line)[2:]}
            assert "0 errors and 1 warning" in done.stdout
            assert "noise of measured positions: 0.02 m" in done.stdout
    chain = {words[1]: words[2:] for words in commands()}
    assert list(chain) == ["check", "train", "discover", "evaluate", "drive"]
    assert told == {word for word in chain["train"] if word.startswith("data")}
    assert told < set(chain["discover"])
    assert sum(took) < LIMIT
    return folder


pytestmark = pytest.mark.thorough


def read(path: Path) -> dict[str, Any]:
    return dict(json.loads(path.read_text(encoding="utf-8")))


def test_the_file_is_looked_at_and_the_law_calibrated(work: Path) -> None:
    assert "Check of mine.csv" in (work / "runs/check/check.html").read_text(encoding="utf-8")
    summary = read(work / "runs/idm/result.json")["summary"]
    assert summary["cost_train"] < summary["cost_start"]
    assert summary["cost_heldout"] < summary["cost_start"]


def test_the_diagnosis_finds_the_zone(work: Path) -> None:
    result = read(work / "runs/lacks/report.json")
    assert result["verdict"] == "named"
    (effect,) = result["effects"]
    assert effect["name"] == "speed_zone"
    value = {name: one["value"] for name, one in effect["coefficients"].items()}
    assert (value["a"], value["b"]) == pytest.approx(ZONE, abs=EDGE)
    assert 1 - value["alpha"] == pytest.approx(1 - SLOWER, rel=SHARE)


def test_the_page_of_motion_holds_the_table(work: Path) -> None:
    page = held(work / "runs/errors/replay.html")
    errors = read(work / "runs/lacks/report.json")["confirmation_errors"]
    assert {scene["name"] for scene in page["scenes"]} == {one["name"] for one in errors}
    table = pd.read_csv(work / "mine.csv")
    for scene in page["scenes"]:
        rows = table[table["sequence"] == int(scene["name"].rpartition("/")[2])]
        own = rows.pivot(index="agent", columns="time", values="x").to_numpy()
        np.testing.assert_allclose(
            np.sort(tracks(scene["measured"]), 0), np.sort(own, 0), atol=0.0051
        )
        (simulated,) = scene["simulated"]
        assert simulated["title"] == "idm_with_speed_zone"
        far = np.sort(tracks(simulated["x"]), 0) - np.sort(own, 0)
        assert np.sqrt((far**2).mean()) < 1.0
    (zone,) = page["zones"]
    assert zone["x"] == pytest.approx(ZONE, abs=EDGE)


def test_vehicles_in_sumo_are_slow_in_the_zone(work: Path) -> None:
    account = read(work / "runs/drive/drive.json")
    assert (account["driven"], account["collisions"], account["teleports"]) == (4, 0, 0)
    assert (account["step"], account["method"]) == (STEP, "ballistic")
    with gzip.open(work / "runs/drive/fcd.xml.gz") as file:
        observed = ElementTree.parse(file).iter("vehicle")
        driven = np.array(
            [float(one.attrib["pos"]) for one in observed if one.attrib["id"] == "c0"]
        )
    x, v, expected = np.array([START]), np.array([SPEED]), [START]
    while x[0] < ZONE[1] + 50:
        new = stepped(x, v, np.array([1e9]), v)
        x, v = x + STEP * (v + new) / 2, new
        expected.append(x[0])
    # s lost in the zone, to one who drives as fast as wanted elsewhere
    lost = [
        np.diff(np.interp(ZONE, way, STEP * np.arange(len(way))))[0]
        - (ZONE[1] - ZONE[0]) / TRUE["v0"]
        for way in (driven, np.array(expected))
    ]
    assert lost[0] == pytest.approx(lost[1], rel=SHARE)
