"""A new law needs only a YAML file and a new effect only an entry of a YAML file.

Both then work in every engine, in training, in the diagnosis and its page, and in SUMO. The files
lie in a copy of the package or in a user's folders.
"""

from __future__ import annotations

import html
import json
import os
import shutil
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from benchmarks.programs import sumo as by_sumo
from nnode.data.readers.sumo import SumoOptions, read_sumo
from tests.app.conftest import ROOT, Script, environment, read_json
from tests.app.forked import Forks
from tests.builders import as_table
from tests.diagnosis import walkers
from tests.diagnosis.platoons import platoons
from tests.exchange.by_sumo import configured

pytestmark = pytest.mark.thorough

#: Laws of vehicles and of people, of first and second order.
LAWS = {
    "saturating": """
  parameters: {v0: {value: 25 m/s, low: 1 m/s}, reach: {value: 15 m, low: 1 m}}
  rate: {x: v0*(1 - exp(-gap/reach))}
""",
    "hurrying": """
  parameters: {v0: {value: 25 m/s, low: 1 m/s}, reach: {value: 15 m, low: 1 m}, tau: 1.5 s}
  rate: {v: (v0*(1 - exp(-gap/reach)) - v)/tau}
""",
    "polite": """
  parameters: {A: 2 m/s², B: 40 cm, tau: 0.7 s}
  where: {push: A*exp((2*r - d)/B)/people, wall: A*exp((r - d)/B)/points}
  others: {push_x: push*n_x, push_y: push*n_y}
  points: {wall_x: wall*n_x, wall_y: wall*n_y}
  rate: {vx: (speed*way_x - vx)/tau + push_x + wall_x, vy: (speed*way_y - vy)/tau + push_y + wall_y}
""",
    "strolling": """
  parameters: {A: 0.5 m/s, B: 40 cm}
  where: {push: A*exp((2*r - d)/B)}
  others: {push_x: push*n_x, push_y: push*n_y}
  rate: {x: pace*way_x + push_x, y: pace*way_y + push_y}
""",
}
IMPORTS = """
from nnode.model.effects import CATALOGUE, Effect, Strength
from nnode.model.term import Interval
from nnode.model.terms import Rule
"""
HILLS = """

@CATALOGUE.add
class Hills(Effect):
    name, domain, source, rank = "hills", "traffic", "none", 20
    rules = {1: Rule(rate="W + w*sin(x/long)", constants={"long": (60.0, "m")})}
    strengths = {"w": Strength(0.0, 0.2, Interval(-6.0, 6.0), "m/s", min_effect_size=1.0)}
"""
#: Entries appended to the package's effects of lanes and of crowds.
EFFECTS = {
    "lane": """
hills:
  about: Hills.
  source: none
  rank: 20
  strengths: {w: {neutral: 0.0, step: 0.2, range: [-6.0, 6.0], unit: m/s, min_effect_size: 1.0}}
  rules: {1: {rate: W + w*sin(x/long), constants: {long: [60.0, m]}}}
""",
    "crowd": """
waves:
  about: Waves.
  source: none
  rank: 20
  strengths: {c: {neutral: 0.0, step: 0.05, range: [-2.0, 2.0], unit: m/s², min_effect_size: 0.2}}
  rules: {2: {rate: [c*sin(x/long), c*cos(x/long)], constants: {long: [1.5, m]}}}
""",
}
#: Parameters of the simulated drivers and people.
V0, REACH, W, C = 27.0, 14.0, 2.5, 0.6
TRUTH = {"saturating.v0": V0, "saturating.reach": REACH, "hills.w": W}
#: Run in the copy: a comparison of all engines, and the speeds of SUMO's vehicles in one step. The
#: generated code of lanes is interpreted here; a training compiles it.
PROGRAM = """
import json
import numpy as np
import nnode
from nnode.app.python.inputs import model_options
from nnode.exchange.drivers import Drivers, DriverInputs
from nnode.model import build_model
from nnode.simulation.kernels import lanes
from tests.simulation import test_engines as engines
from tests.simulation.kernels.interpreted import interpreted

lanes.compiled = interpreted
for law, effects, method in (("saturating", ["hills"], "rk4"), ("hurrying", [], "ballistic")):
    options = model_options(law, "measured", [{"name": e, "w": 1.5} for e in effects])
    parts = engines.compiled, engines.ensemble, engines.by_tangents
    engines.check(build_model(options), engines.platoons(), method, *parts)
for law, effects in (("polite", ["waves"]), ("strolling", [])):
    options = model_options(law, None, [{"name": e, "c": 0.3} for e in effects])
    system = build_model({**options, "desired": "direction"})
    engines.check(system, engines.room(), "euler", engines.compiled, engines.threaded)

model = build_model(model_options("saturating", "measured", [{"name": "hills", "w": 2.5}]))
drivers = Drivers(model, 0.1, "euler")
drivers.enter([(), ()])
gap, nobody = np.array([20.0, 30.0]), np.full(2, np.inf)
inputs = DriverInputs(v=np.full(2, 9.0), gap=gap, v_1=np.full(2, 9.0), length_1=np.full(2, 5.0),
            lead=np.full(2, -1), gap_1=nobody, v_2=np.full(2, 9.0), x=np.array([35.0, 80.0]))
print(json.dumps({"package": nnode.__file__, "speeds": drivers.speeds(0.0, inputs).tolist()}))
"""


def speeds(x: np.ndarray) -> np.ndarray:
    """Speeds of followers (m/s) by law and effect; the leader's position is last in ``x``."""
    law: np.ndarray = V0 * (1 - np.exp(-np.diff(x) / REACH))
    return law + W * np.sin(x[..., :-1] / 60)


def waves(x: np.ndarray) -> np.ndarray:
    """Accelerations (m/s²) of people at ``(..., 2)``."""
    phase = x[..., 0] / 1.5
    return C * np.stack([np.sin(phase), np.cos(phase)], -1)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of the package with the new files, and tables of both domains."""
    copied = tmp_path_factory.mktemp("extended")
    for part in ("nnode", "conf", "scripts"):
        shutil.copytree(ROOT / part, copied / part, ignore=shutil.ignore_patterns("__pycache__"))
    for rank, (name, text) in enumerate(LAWS.items(), 90):
        head = f"  about: A law.\n  source: none\n  rank: {rank}"
        (copied / "nnode" / "model" / "laws" / f"{name}.yaml").write_text(head + text, "utf-8")
    for name, text in EFFECTS.items():
        path = copied / "nnode" / "model" / "effects" / f"{name}.yaml"
        path.write_text(path.read_text("utf-8") + text, "utf-8")
    driven = platoons(lambda x, *_: speeds(x), number=16, vehicles=4, seconds=16.0, seed=4)
    as_table(driven).to_csv(copied / "platoons.csv", index=False)
    walked = walkers.crowd(lambda x, *_: waves(x), sequences=17, samples=40)
    as_table(walked).to_csv(copied / "people.csv", index=False)
    walls = pd.DataFrame(walkers.WALLS, columns=["x1", "y1", "x2", "y2"])
    walls.to_csv(copied / "walls.csv", index=False)
    return copied


@pytest.fixture(scope="module")
def copy(folder: Path) -> Iterator[Script]:
    """Runs a script of the copy, or code."""
    path = os.pathsep.join([str(folder), str(ROOT), os.environ.get("PYTHONPATH", "")])
    processes = Forks(folder, {**environment(), "PYTHONPATH": path, "PYTHONSAFEPATH": "1"})
    yield processes.run
    processes.close()


def test_engines_agree_and_sumo_s_speeds_are_right(copy: Script, folder: Path) -> None:
    result = json.loads(copy(PROGRAM).stdout)
    assert Path(result["package"]).parents[1] == folder
    x, gap = np.array([35.0, 80.0]), np.array([20.0, 30.0])
    expected = 25 * (1 - np.exp(-gap / 15)) + W * np.sin(x / 60)
    np.testing.assert_allclose(result["speeds"], expected, rtol=1e-6)


def options(folder: Path, run: Path) -> list[str]:
    """Options of a training of the traffic law with the effect."""
    return [
        "model.effects=[hills]",
        "data=table",
        "data.domain=traffic",
        f"data.path={folder / 'platoons.csv'}",
        "solver=fused",
        "optimizer=gauss_newton",
        "trainer.max_epochs=30",
        f"hydra.run.dir={run}",
    ]


@pytest.fixture(scope="module")
def trained(copy: Script, folder: Path) -> Path:
    """The folder of a training in the copy."""
    run = folder / "run"
    copy("train", "model=saturating", "model.leader=measured", *options(folder, run))
    return run


def estimates(run: Path) -> dict[str, float]:
    result = read_json(run / "result.json")
    assert result["solver"] == {"name": "fused", "uncompiled": None}
    return {name: result["summary"][name] for name in TRUTH}


def test_training_recovers_the_parameters(trained: Path) -> None:
    assert estimates(trained) == pytest.approx(TRUTH, rel=0.02)


def test_user_s_files_give_the_same(script: Script, folder: Path, tmp_path: Path) -> None:
    """The law lies in a configuration folder, the effect in a file named by ``NNODE_EFFECTS``."""
    conf = tmp_path / "conf" / "model"
    conf.mkdir(parents=True)
    head = "defaults: [formula_schema, _self_]\nname: saturating\nleader: measured\nlaw:"
    (conf / "mine.yaml").write_text(head + LAWS["saturating"], "utf-8")
    (tmp_path / "effects.py").write_text(IMPORTS + HILLS)
    words = ["--config-dir", str(conf.parent), "model=mine", *options(folder, tmp_path / "run")]
    script("train", *words, NNODE_EFFECTS=str(tmp_path / "effects.py"))
    assert estimates(tmp_path / "run") == pytest.approx(TRUTH, rel=0.02)


@pytest.mark.parametrize("law", ["polite", "strolling"])
def test_training_of_people(copy: Script, law: str, tmp_path: Path) -> None:
    copy(
        "train",
        f"model={law}",
        *["model.effects=[waves]"] * (law == "polite"),
        *("data=table", "data.domain=crowd", "data.path=people.csv", "data.walls=walls.csv"),
        *("solver=fused", "trainer.max_epochs=1"),
        folder=tmp_path,
    )
    result = read_json(tmp_path / "result.json")
    assert result["solver"] == {"name": "fused", "uncompiled": None}
    assert {f"{law}.A", f"{law}.B"} <= set(result["summary"])
    assert ("waves.c" in result["summary"]) is (law == "polite")


@pytest.mark.parametrize(
    ("effect", "strength", "value", "options"),
    [
        (
            "hills",
            "w",
            W,
            "model=saturating model.leader=measured data.domain=traffic data.path=platoons.csv",
        ),
        (
            "waves",
            "c",
            C,
            "model=polite data.domain=crowd data.path=people.csv data.walls=walls.csv",
        ),
    ],
)
def test_diagnosis_names_the_effect(
    copy: Script, effect: str, strength: str, value: float, options: str, tmp_path: Path
) -> None:
    only_this_law = ["discover.compare=[]", "discover.structure=false"]
    folder = f"hydra.run.dir={tmp_path}"
    copy("discover", "data=table", *options.split(), *only_this_law, folder)
    report = read_json(tmp_path / "report.json")
    assert report["verdict"] == "named"
    (named,) = report["effects"]
    assert named["name"] == effect
    low, high = (named["coefficients"][strength][end] for end in ("low", "high"))
    # errors of 2 cm give intervals of 0.03 %, and smoothed leaders shift estimates by as much
    assert low - 1e-3 * value < value < high + 1e-3 * value
    page = html.unescape((tmp_path / "report.html").read_text())
    assert effect in page
    assert "sin" in named["formula"]
    assert named["formula"] in page


def test_vehicles_in_sumo_follow_the_law(copy: Script, trained: Path, tmp_path: Path) -> None:
    by_sumo.write_scene(
        Path(pytest.importorskip("sumo").SUMO_HOME), tmp_path, "Krauss", {"decel": 4.5}
    )
    path = configured(tmp_path, end=20.0)
    words = (f"run={trained}", f"sumo={path}", "vehicles=own", "steps=scenario")
    copy("drive", *words, folder=tmp_path / "out")
    (observed,) = read_sumo(tmp_path / "out" / "fcd.xml.gz", SumoOptions(path="", dt=0.1))
    v0, reach, w = estimates(trained).values()
    x = observed.x[..., 0]
    expected = v0 * (1 - np.exp(-np.diff(x) / reach)) + w * np.sin(x[:, :-1] / 60)
    np.testing.assert_allclose(np.diff(x[1:, :-1], axis=0) / 0.1, expected[1:-1], atol=1e-6)
