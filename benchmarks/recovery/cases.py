"""Programs and laws, what is typed in, and how each is recovered."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.recovery import by_jupedsim, by_sumo, laws
from benchmarks.recovery.recover import Recovered, recover
from nnode.data.readers.sumo import SumoOptions, read_sumo
from nnode.data.sequence import Sequence
from nnode.model.laws import CAR_FOLLOWING_LAWS, PEDESTRIAN_LAWS

#: What SUMO calls the parameters.
_SUMO = {"v0": "maxSpeed", "T": "tau", "s0": "minGap", "a": "accel", "b": "decel"}
_IDM = {"v0": 28.0, "T": 1.1, "s0": 2.3, "a": 1.4, "b": 2.0}
_KRAUSS = {"v0": 21.0, "T": 1.1, "s0": 2.3, "a": 1.9, "b": 3.5}
#: A leader that never drives at the followers' v0 and never stops.
SLOWLY = np.array(
    [
        (0, 8),
        (6, 8),
        (11, 14),
        (17, 14),
        (20, 6),
        (28, 5),
        (34, 12),
        (40, 12),
        (45, 4),
        (52, 13),
        (60, 10),
    ],
    dtype=float,
)
#: JuPedSim's people: mass, kg, desired speed, m/s, time to reach it, s.
_MASS, _PACE, _TAU = 80.0, 1.3, 0.5
#: Errors of measured positions, m: of vehicles, of people.
ROAD, ROOM = 0.1, 0.01


@dataclass(frozen=True)
class Case:
    """A law of another program, and the law here that is calibrated to it.

    Attributes:
        program: which one, and its law.
        law: what it is called here.
        recovered: simulates in a folder, and calibrates.
    """

    program: str
    law: str
    recovered: Callable[[Path], Recovered]


def _sumo(
    program: str,
    follow: str,
    name: str,
    law: dict[str, Any],
    typed: dict[str, float],
    *,
    ballistic: bool = False,
    emergency: float = 9.0,
    **scene: Any,
) -> Case:
    def recovered(folder: Path) -> Recovered:
        home = Path(import_module("sumo").SUMO_HOME)
        values = {_SUMO[part]: value for part, value in typed.items()}
        values |= {"emergencyDecel": emergency} | ({} if follow == "IDM" else {"sigma": 0.0})
        path = by_sumo.platoon(home, folder, follow, values, ballistic=ballistic, **scene)
        (found,) = read_sumo(path, SumoOptions(path=str(path), dt=by_sumo.STEP))
        # SUMO does not write them
        found = replace(found, length=np.full(found.n_agents, by_sumo.LENGTH))
        method = "ballistic" if ballistic else "semi_implicit"
        return recover(law, typed, [found], dt=by_sumo.STEP, method=method, error=ROAD)

    return Case(f"SUMO, {program}", name, recovered)


def _social_force(program: str, name: str, typed: dict[str, float], *, own: bool) -> Case:
    """A case; ``own``: the law steps as JuPedSim does, else as Euler does."""

    def recovered(folder: Path) -> Recovered:
        jupedsim = import_module("jupedsim")
        model = jupedsim.SocialForceModel(
            body_force=typed["k"] * _MASS, friction=typed["kappa"] * _MASS
        )
        values = {
            "mass": _MASS,
            "desired_speed": typed["v0"],
            "reaction_time": typed["tau"],
            "agent_scale": typed["A"] * _MASS,
            "force_distance": typed["B"],
            "radius": 0.3,
        }
        sequences = [
            by_jupedsim.groups(
                jupedsim,
                folder / f"{seed}.sqlite",
                model,
                jupedsim.SocialForceModelAgentParameters,
                values,
                seed=seed,
                before=own,
            )
            for seed in range(2)
        ]
        law = laws.stepping(laws.SOCIAL_FORCE, by_jupedsim.STEP if own else 0.0)
        return recover(law, typed, sequences, dt=by_jupedsim.STEP, error=ROOM)

    return Case(f"JuPedSim, {program}", name, recovered)


def _centrifugal() -> Case:
    typed = {"eta": 0.3, "v0": _PACE, "tau": _TAU, "a_v": 0.5}

    def recovered(folder: Path) -> Recovered:
        jupedsim = import_module("jupedsim")
        model = jupedsim.GeneralizedCentrifugalForceModel(strength_neighbor_repulsion=typed["eta"])
        values = {
            "mass": 1.0,
            "desired_speed": typed["v0"],
            "tau": typed["tau"],
            "a_v": typed["a_v"],
            "a_min": 0.2,
            "b_min": 0.2,
            "b_max": 0.4,
        }
        # JuPedSim turns desired directions slowly: goals so far away that they do not turn
        sequences = [
            by_jupedsim.groups(
                jupedsim,
                folder / f"{seed}.sqlite",
                model,
                jupedsim.GeneralizedCentrifugalForceModelAgentParameters,
                values,
                seed=seed,
                before=True,
                apart=1.2,
                speed=1.0,
                oriented=True,
                goal=9000.0,
            )
            for seed in range(2)
        ]
        law = laws.stepping(laws.CENTRIFUGAL, by_jupedsim.STEP)
        # who passes on which side is a matter of yes and no: long paths have many local minima
        parts = [part for whole in sequences for part in by_jupedsim.pieces(whole, seconds=1.0)]
        return recover(law, typed, parts, dt=by_jupedsim.STEP, error=ROOM)

    return Case("JuPedSim, generalised centrifugal force", "its formula, its steps", recovered)


def _collision_free() -> Case:
    typed = {"T": 1.0, "l": 0.4, "a": 8.0, "D": 0.1}

    def recovered(folder: Path) -> Recovered:
        law = PEDESTRIAN_LAWS["cfsm"]
        jupedsim = import_module("jupedsim")
        model = jupedsim.CollisionFreeSpeedModel(
            strength_neighbor_repulsion=typed["a"], range_neighbor_repulsion=typed["D"]
        )
        values = {"time_gap": typed["T"], "desired_speed": _PACE, "radius": typed["l"] / 2}
        pieces: list[Sequence] = []
        for seed in range(2):
            found = by_jupedsim.groups(
                jupedsim,
                folder / f"{seed}.sqlite",
                model,
                jupedsim.CollisionFreeSpeedModelAgentParameters,
                values,
                seed=seed,
            )
            assert found.destination is not None
            # whose way is free is a matter of yes and no: long paths have many local minima
            way = np.sign(found.destination[:, :1]) * np.array([[_PACE, 0.0]])
            wants: dict[str, Any] = {"preferred": way}
            pieces += by_jupedsim.pieces(replace(found, **wants), seconds=1.0)
        return recover(law, typed, pieces, dt=by_jupedsim.STEP, error=ROOM)

    return Case("JuPedSim, collision-free speed", "`cfsm`", recovered)


#: By the names that the command knows.
CASES: dict[str, Case] = {
    "idm_euler": _sumo("IDM, Euler", "IDM", "`idm`", CAR_FOLLOWING_LAWS["idm"], _IDM),
    "idm_ballistic": _sumo(
        "IDM, ballistic", "IDM", "`idm`", CAR_FOLLOWING_LAWS["idm"], _IDM, ballistic=True
    ),
    "idm_ballistic_rest": _sumo(
        "IDM, ballistic", "IDM", "`idm`, a ≥ −v/dt", laws.IDM, _IDM, ballistic=True
    ),
    "krauss_moving": _sumo(
        "KraussOrig1, Euler, never at rest nor at v0",
        "KraussOrig1",
        "`krauss`",
        CAR_FOLLOWING_LAWS["krauss"],
        _KRAUSS,
        profile=SLOWLY,
    ),
    "krauss_stopping": _sumo(
        "KraussOrig1, Euler", "KraussOrig1", "`krauss`", CAR_FOLLOWING_LAWS["krauss"], _KRAUSS
    ),
    "krauss_crawl": _sumo(
        "KraussOrig1, Euler",
        "KraussOrig1",
        "`krauss`, last b dt at b dt",
        laws.KRAUSS_ORIG,
        _KRAUSS,
    ),
    "krauss_ballistic": _sumo(
        "Krauss, ballistic, emergencyDecel = decel",
        "Krauss",
        "its formula",
        laws.KRAUSS_BALLISTIC,
        _KRAUSS,
        ballistic=True,
        emergency=_KRAUSS["b"],
    ),
    "krauss_default": _sumo(
        "Krauss, Euler: SUMO's default", "Krauss", "`krauss`", CAR_FOLLOWING_LAWS["krauss"], _KRAUSS
    ),
    "force_contact": _social_force(
        "social force, people touch",
        "its formula, its steps",
        {"A": 2.0, "B": 0.3, "k": 150.0, "kappa": 50.0, "v0": _PACE, "tau": _TAU},
        own=True,
    ),
    "force_euler": _social_force(
        "social force, people touch",
        "its formula, Euler's steps",
        {"A": 2.0, "B": 0.3, "k": 150.0, "kappa": 50.0, "v0": _PACE, "tau": _TAU},
        own=False,
    ),
    "force_default": _social_force(
        "social force, its defaults: nobody touches",
        "its formula, its steps",
        {"A": 25.0, "B": 0.08, "k": 1500.0, "kappa": 3000.0, "v0": _PACE, "tau": _TAU},
        own=True,
    ),
    "centrifugal": _centrifugal(),
    "collision_free": _collision_free(),
}
