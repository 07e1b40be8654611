"""Laws drive SUMO's vehicles: SUMO's paths equal those of the compiled simulation.

SUMO writes nine decimals. The rounding error of initial states and leaders is at most 5e-10 m, and
stable laws do not amplify it. Larger tolerances are explained in their tests.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from benchmarks.programs import sumo as by_sumo
from benchmarks.programs.laws import LAWS
from benchmarks.programs.sumo import SLOWLY
from nnode.app.python.inputs import model_options
from nnode.data.readers.sumo import SumoOptions, read_sumo
from nnode.data.sequence import Sequence, collate
from nnode.errors import ConfigError
from nnode.exchange.drive import Drive, drive
from nnode.exchange.running_sumo import RunningSumo, Steps
from nnode.model import System, build_model
from nnode.simulation import FusedSolver
from tests.exchange.by_sumo import configured

#: Rounding error of SUMO's output (m), on both sides.
ROUNDED = 1e-9
LIN = {"v0": 15.0, "L": 9.0}


def model(name: str | Mapping[str, Any], *effects: dict[str, Any], **values: float) -> System:
    """A model with effects and values of the law's parameters."""
    options = {**model_options(name, "measured"), "effects": list(effects)}
    result = build_model(options).double()
    with torch.no_grad():
        for parameter, value in values.items():
            getattr(result.terms[0], parameter).fill_(value)
    return result


def scenario(
    sumo: Path,
    folder: Path,
    *,
    ballistic: bool = False,
    step: float = 0.1,
    speed: float = 12.0,
) -> Path:
    """One leader and seven followers on a road."""
    by_sumo.write_scene(sumo, folder, "Krauss", {"decel": 4.5}, speed=speed)
    return configured(folder, step=step, end=by_sumo.SECONDS + step, ballistic=ballistic)


def led(profile: np.ndarray) -> Any:
    """A function that sets the leader's speed from a profile."""

    def steer(sumo: RunningSumo) -> None:
        if "c0" in sumo.vehicles:
            sumo.api.vehicle.setSpeedMode("c0", 0)
            speed = np.interp(sumo.time + sumo.seconds, *profile.T)
            sumo.api.vehicle.setSpeed("c0", float(speed))

    return steer


def driven(
    system: System,
    sumo: Path,
    program: str,
    folder: Path,
    *,
    ballistic: bool = False,
    profile: np.ndarray = by_sumo.PROFILE,
    **options: Any,
) -> tuple[Drive, Sequence]:
    """The drive and SUMO's trajectories; vehicle lengths are added to the latter."""
    path = scenario(sumo, folder, ballistic=ballistic, speed=float(profile[0, 1]))
    result = drive(
        system, path, ["own"], folder / "out", program=program, steer=led(profile), **options
    )
    (observed,) = read_sumo(result.trajectories, SumoOptions(path=str(result.trajectories), dt=0.1))
    return result, replace(observed, length=np.full(observed.n_agents, by_sumo.LENGTH))


def largest_distance(system: System, observed: Sequence, method: str) -> float:
    """The largest distance (m) between vehicles in SUMO and in the compiled simulation."""
    batch = collate([observed])
    assert batch.n_samples == round(by_sumo.SECONDS / by_sumo.STEP) + 1
    with torch.no_grad():
        path = FusedSolver(dt=by_sumo.STEP, method=method)(system, batch)
    return float((path.x - batch.x).abs().max())


def test_idm_with_euler_steps(sumo: Path, program: str, tmp_path: Path) -> None:
    system = model("idm")
    result, observed = driven(system, sumo, program, tmp_path)
    assert largest_distance(system, observed, "semi_implicit") < ROUNDED
    assert observed.v is not None
    assert observed.v.min() == 0  # vehicles stop and do not reverse
    assert (result.driven, result.steps, result.collisions, result.teleports) == (7, 601, 0, 0)
    assert result.stranded == 0
    assert result.mean_speed == pytest.approx(observed.v[:, :-1].mean(), rel=0.01)


def test_idm_with_ballistic_steps(sumo: Path, program: str, tmp_path: Path) -> None:
    # A step that ends at rest has the length v²/(2|a|) here and v dt/2 in SUMO. The difference is
    # at most b dt²/8 = 2 mm for b = 1.7 m/s², and it adds up over seven vehicles.
    system = model("idm")
    _, observed = driven(system, sumo, program, tmp_path, ballistic=True)
    assert ROUNDED < largest_distance(system, observed, "ballistic") < 0.01


@pytest.mark.thorough
def test_libsumo_and_traci_agree(sumo: Path, tmp_path: Path) -> None:
    pytest.importorskip("libsumo")
    observed = [
        driven(model("idm"), sumo, program, tmp_path / program)[1]
        for program in ("libsumo", "traci")
    ]
    np.testing.assert_array_equal(observed[0].x, observed[1].x)


FIRST_ORDER = {
    "lin": [],
    "chained": [{"relative_speed": {"kappa": 0.3}}],
    "inertia": [{"inertia": {"tau_v": 0.2}}, {"time_gap": {"h": 0.2}}],
    "delay": [{"reaction_delay": {"T": 0.3}}],
    "two ahead": [{"multi_anticipation": {"c": 0.3}}],
    "place": [{"speed_zone": {"alpha": 0.7, "a": 500.0, "b": 650.0}}],
    "clock": [{"speed_period": {"alpha": 0.7, "a": 20.0, "b": 30.0}}],
    "class": [{"vehicle_class": {"kind": "own", "phi": 0.8}}],
}
SECOND_ORDER = {
    "relative_speed": {"kappa": 0.3},
    "memory": {"tau_m": 60.0},
    "lasting_time_gap": {"share": 0.6},
    "pure_delay": {"T": 0.35},
    "reaction_delay": {"T": 0.5},
    "inertia": {"tau_v": 0.5},
    "multi_anticipation": {"c": 0.3},
    "speed_zone": {"alpha": 0.7, "a": 500.0, "b": 650.0},
}


def network(name: str, *layers: tuple[list[list[float]], list[float]]) -> System:
    """A network model with given weights and biases."""
    system = model(name)
    with torch.no_grad():
        for layer, (weight, bias) in zip(system.terms[0].network.layers, layers, strict=True):
            layer.weight.copy_(torch.tensor(weight))
            layer.bias.copy_(torch.tensor(bias))
    return system


ACCELERATIONS = partial(
    network, "a2", ([[2.0, -1.2, -1.0], [-2.0, 1.2, 1.0]], [-0.7, 0.7]), ([[1.0, -1.5]], [0.35])
)
SPEEDS = partial(
    network,
    "n4",
    ([[0.25], [0.25], [-0.25], [0.05]], [-2.0, -9.0, 1.0, -1.0]),
    ([[3.0, -3.0, -0.1, 0.01]], [0.0]),
)


def case(
    name: str,
    make: Callable[[], System],
    method: str,
    *marks: Any,
    tolerance: float = ROUNDED,
    **scene: Any,
) -> Any:
    return pytest.param(make, method, scene, tolerance, id=name, marks=marks)


@pytest.mark.parametrize(
    ("make", "method", "scene", "tolerance"),
    [
        *(
            case(
                f"lin {name}",
                partial(model, "lin", *effects, **LIN),
                "euler",
                pytest.mark.thorough,
                profile=SLOWLY,
                far=200.0,
            )
            for name, effects in FIRST_ORDER.items()
        ),
        *(
            case(
                f"idm {name}",
                partial(model, "idm", {name: values}),
                "semi_implicit",
                tolerance=2 * ROUNDED,
            )
            for name, values in SECOND_ORDER.items()
        ),
        *(
            case(name, partial(model, name), "semi_implicit", pytest.mark.thorough, far=200.0)
            for name in ("krauss", "gipps", "newell")
        ),
        # this law brakes by at most v/dt, so that no step ends at rest
        case(
            "own",
            partial(model, {"term": "formula", "name": "own", "law": LAWS["sumo_idm"]}),
            "ballistic",
        ),
        case("a2", ACCELERATIONS, "semi_implicit", profile=SLOWLY, far=100.0),
        case("a2 ballistic", ACCELERATIONS, "ballistic", profile=SLOWLY, far=100.0),
        case("n4", SPEEDS, "euler", profile=SLOWLY, far=100.0),
    ],
)
def test_sumo_agrees_with_the_compiled_simulation(
    sumo: Path,
    program: str,
    tmp_path: Path,
    make: Callable[[], System],
    method: str,
    scene: dict[str, Any],
    tolerance: float,
) -> None:
    system = make()
    _, observed = driven(system, sumo, program, tmp_path, ballistic=method == "ballistic", **scene)
    assert largest_distance(system, observed, method) < tolerance


def two_edges(home: Path, folder: Path, *, length: int, lanes: int, speed: int) -> None:
    """A road of two edges: the first has two lanes, the second ``lanes``."""
    nodes = (
        f'<node id="a" x="0" y="0"/><node id="b" x="{length}" y="0"/>'
        f'<node id="c" x="{2 * length}" y="0"/>'
    )
    edges = (
        f'<edge id="e" from="a" to="b" numLanes="2" speed="{speed}"/>'
        f'<edge id="f" from="b" to="c" numLanes="{lanes}" speed="{speed}"/>'
    )
    by_sumo.network(home, folder, nodes, edges)


def with_and_without_lane_changes(system: System, program: str, path: Path) -> list[Drive]:
    return [
        drive(
            system, path, ["own"], path.parent / str(allowed), program=program, lane_changes=allowed
        )
        for allowed in (True, False)
    ]


@pytest.mark.thorough
def test_vehicles_enter_leave_and_overtake(sumo: Path, program: str, tmp_path: Path) -> None:
    """A flow of vehicles behind a slow vehicle on a road with two lanes."""
    two_edges(sumo, tmp_path, length=400, lanes=2, speed=30)
    (tmp_path / "a.rou.xml").write_text(
        '<routes><vType id="own" speedDev="0"/><vType id="slow" maxSpeed="6" sigma="0"/>'
        '<route id="r" edges="e f"/><vehicle id="s" type="slow" route="r" depart="0"/>'
        '<flow id="q" type="own" route="r" begin="1" end="40" period="4" departLane="0" '
        'departSpeed="8"/></routes>'
    )
    system = model("idm", {"pure_delay": {"T": 0.3}})
    overtaking, following = results = with_and_without_lane_changes(
        system, program, configured(tmp_path)
    )
    for result in results:
        assert (result.driven, result.collisions, result.teleports) == (10, 0, 0)
    assert following.mean_speed is not None
    assert overtaking.mean_speed is not None
    # without lane changes, vehicles follow the slow one at 6 m/s
    assert following.mean_speed < 8 < 10 < overtaking.mean_speed


def test_vehicles_at_the_end_of_a_lane_are_stranded(
    sumo: Path, program: str, tmp_path: Path
) -> None:
    two_edges(sumo, tmp_path, length=200, lanes=1, speed=20)
    (tmp_path / "a.rou.xml").write_text(
        '<routes><vType id="own"/><route id="r" edges="e f"/>'
        + "".join(
            f'<vehicle id="v{i}" type="own" route="r" depart="0" departLane="{i}"/>' for i in (0, 1)
        )
        + "</routes>"
    )
    path = configured(tmp_path, end=60.0)
    changing, staying = with_and_without_lane_changes(model("idm"), program, path)
    assert (staying.driven, staying.stranded, staying.steps) == (2, 1, 600)
    assert changing.driven == 2
    assert changing.steps < 400  # all vehicles have arrived


def test_scenario_with_other_steps_is_refused(sumo: Path, program: str, tmp_path: Path) -> None:
    path = scenario(sumo, tmp_path, step=0.5)
    steps = Steps(0.1, "ballistic")
    start = partial(drive, model("idm"), path, ["own"], tmp_path, program=program, expected=steps)
    with pytest.raises(
        ConfigError, match=r"semi_implicit steps of 0\.5 s.*ballistic steps of 0\.1"
    ):
        start()
    result = start(forced_steps=steps, end=5.0)
    assert (result.step, result.method, result.steps) == (0.1, "ballistic", 50)


def test_first_order_law_refuses_ballistic_steps(sumo: Path, program: str, tmp_path: Path) -> None:
    path = scenario(sumo, tmp_path, ballistic=True)
    with pytest.raises(ConfigError, match=r"step-method\.ballistic.*Euler's steps"):
        drive(model("lin"), path, ["own"], tmp_path, program=program)


def test_invalid_scenarios_are_refused(sumo: Path, program: str, tmp_path: Path) -> None:
    path = scenario(sumo, tmp_path)
    for file, vehicles, message in (
        (path, "car", r"vehicles=car is no vehicle type.*lead, own"),
        (tmp_path / "none.sumocfg", "own", r"none\.sumocfg is not there"),
        (tmp_path / "a.net.xml", "own", r"a\.net\.xml cannot be loaded by SUMO"),
    ):
        with pytest.raises(ConfigError, match=message):
            drive(model("idm"), file, [vehicles], tmp_path, program=program)
    routes = tmp_path / "a.rou.xml"
    routes.write_text(routes.read_text().replace('id="own"', 'id="own" actionStepLength="1"'))
    with pytest.raises(ConfigError, match="actionStepLength is 1 s"):
        drive(model("idm"), path, ["own"], tmp_path, program=program)


def test_unknown_program_is_refused(sumo: Path, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"program=matsim is unknown, .* libsumo, traci"):
        drive(model("idm"), scenario(sumo, tmp_path), ["own"], tmp_path, program="matsim")
