"""Parameters that are typed into SUMO and JuPedSim, recovered from what the programs simulate."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pandas as pd

from benchmarks.config import DiscoveryBenchmarkOptions
from benchmarks.discovery.recover import Recovered, recover
from benchmarks.programs import jupedsim as people
from benchmarks.programs import laws, sumo
from nnode.data.readers.sumo import SumoOptions, read_sumo
from nnode.model.laws import CAR_FOLLOWING_LAWS, PEDESTRIAN_LAWS
from nnode.pages.page import Block, Heading, TableBlock

#: SUMO's names of the parameters.
_SUMO = {"v0": "maxSpeed", "T": "tau", "s0": "minGap", "a": "accel", "b": "decel"}
_IDM = {"v0": 28.0, "T": 1.1, "s0": 2.3, "a": 1.4, "b": 2.0}
_KRAUSS = {"v0": 21.0, "T": 1.1, "s0": 2.3, "a": 1.9, "b": 3.5}
#: JuPedSim's people: mass, kg, desired speed, m/s, time to reach it, s.
_MASS, _PACE, _TAU = 80.0, 1.3, 0.5
_TOUCH = {"A": 2.0, "B": 0.3, "k": 150.0, "kappa": 50.0, "v0": _PACE, "tau": _TAU}
#: Errors of measured positions, m: of vehicles, of people.
ROAD, ROOM = 0.1, 0.01


@dataclass(frozen=True)
class Case:
    """A law of another program, and the law of this package that is calibrated to its paths.

    Attributes:
        program: its name, and its law.
        law: what it is called here.
        recovered: simulates in a folder, and calibrates.
    """

    program: str
    law: str
    recovered: Callable[[Path], Recovered]


def _by_sumo(
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
        values = {_SUMO[part]: value for part, value in typed.items()}
        values |= {"emergencyDecel": emergency} | ({} if follow == "IDM" else {"sigma": 0.0})
        home = sumo.sumo_home()
        path = sumo.platoon(home, folder, follow, values, ballistic=ballistic, **scene)
        (found,) = read_sumo(path, SumoOptions(path=str(path), dt=sumo.STEP))
        # SUMO does not write them
        found = replace(found, length=np.full(found.n_agents, sumo.LENGTH))
        method = "ballistic" if ballistic else "semi_implicit"
        return recover(law, typed, [found], dt=sumo.STEP, method=method, error=ROAD)

    return Case(f"SUMO, {program}", name, recovered)


def _by_jupedsim(
    program: str,
    kind: str,
    name: str,
    law: dict[str, Any],
    typed: dict[str, float],
    model: dict[str, float],
    person: dict[str, float],
    *,
    preferred: bool = False,
    parts: bool = False,
    **scene: Any,
) -> Case:
    """A case of JuPedSim.

    Args:
        kind: JuPedSim's name of the model.
        model, person: arguments of the model, and of every agent.
        preferred: the law reads preferred velocities.
        parts: paths are calibrated in pieces of 1 s. Who passes on which side changes abruptly, and
            long paths have many local minima.
    """

    def recovered(folder: Path) -> Recovered:
        jupedsim = import_module("jupedsim")
        found = []
        for seed in range(2):
            whole = people.groups(
                jupedsim,
                folder / f"{seed}.sqlite",
                getattr(jupedsim, kind)(**model),
                getattr(jupedsim, f"{kind}AgentParameters"),
                person,
                seed=seed,
                **scene,
            )
            if preferred:
                assert whole.destination is not None
                velocity = np.sign(whole.destination[:, :1]) * np.array([[_PACE, 0.0]])
                whole = replace(whole, preferred=velocity)
            found += people.pieces(whole, seconds=1.0) if parts else [whole]
        return recover(law, typed, found, dt=people.STEP, error=ROOM)

    return Case(f"JuPedSim, {program}", name, recovered)


def _social_force(program: str, steps: str, typed: dict[str, float]) -> Case:
    """``steps``: ``its`` if the law steps as JuPedSim does, else ``Euler's``."""
    same = steps == "its"
    return _by_jupedsim(
        f"social force, {program}",
        "SocialForceModel",
        f"its formula, {steps} steps",
        laws.stepping(laws.SOCIAL_FORCE, people.STEP if same else 0.0),
        typed,
        {"body_force": typed["k"] * _MASS, "friction": typed["kappa"] * _MASS},
        {
            "mass": _MASS,
            "desired_speed": typed["v0"],
            "reaction_time": typed["tau"],
            "agent_scale": typed["A"] * _MASS,
            "force_distance": typed["B"],
            "radius": 0.3,
        },
        before=same,
    )


_KRAUSS_LAW = CAR_FOLLOWING_LAWS["krauss"]
#: By name.
CASES: dict[str, Case] = {
    "idm_euler": _by_sumo("IDM, Euler", "IDM", "`idm`", CAR_FOLLOWING_LAWS["idm"], _IDM),
    "idm_ballistic": _by_sumo(
        "IDM, ballistic", "IDM", "`idm`", CAR_FOLLOWING_LAWS["idm"], _IDM, ballistic=True
    ),
    "idm_ballistic_rest": _by_sumo(
        "IDM, ballistic", "IDM", "`idm`, a ≥ −v/dt", laws.IDM, _IDM, ballistic=True
    ),
    "krauss_moving": _by_sumo(
        "KraussOrig1, Euler, never at rest nor at v0",
        "KraussOrig1",
        "`krauss`",
        _KRAUSS_LAW,
        _KRAUSS,
        profile=sumo.SLOWLY,
    ),
    "krauss_stopping": _by_sumo(
        "KraussOrig1, Euler", "KraussOrig1", "`krauss`", _KRAUSS_LAW, _KRAUSS
    ),
    "krauss_crawl": _by_sumo(
        "KraussOrig1, Euler",
        "KraussOrig1",
        "`krauss`, last b dt at b dt",
        laws.KRAUSS_ORIG,
        _KRAUSS,
    ),
    "krauss_ballistic": _by_sumo(
        "Krauss, ballistic, emergencyDecel = decel",
        "Krauss",
        "its formula",
        laws.KRAUSS_BALLISTIC,
        _KRAUSS,
        ballistic=True,
        emergency=_KRAUSS["b"],
    ),
    "krauss_default": _by_sumo(
        "Krauss, Euler: SUMO's default", "Krauss", "`krauss`", _KRAUSS_LAW, _KRAUSS
    ),
    "force_contact": _social_force("people touch", "its", _TOUCH),
    "force_euler": _social_force("people touch", "Euler's", _TOUCH),
    "force_default": _social_force(
        "its defaults: nobody touches",
        "its",
        {"A": 25.0, "B": 0.08, "k": 1500.0, "kappa": 3000.0, "v0": _PACE, "tau": _TAU},
    ),
    "centrifugal": _by_jupedsim(
        "generalised centrifugal force",
        "GeneralizedCentrifugalForceModel",
        "its formula, its steps",
        laws.stepping(laws.CENTRIFUGAL, people.STEP),
        {"eta": 0.3, "v0": _PACE, "tau": _TAU, "a_v": 0.5},
        {"strength_neighbor_repulsion": 0.3},
        {
            **{"mass": 1.0, "desired_speed": _PACE, "tau": _TAU, "a_v": 0.5},
            **{"a_min": 0.2, "b_min": 0.2, "b_max": 0.4},
        },
        parts=True,
        before=True,
        apart=1.2,
        speed=1.0,
        oriented=True,
        # JuPedSim turns desired directions slowly: goals so far away that they do not turn
        goal=9000.0,
    ),
    "collision_free": _by_jupedsim(
        "collision-free speed",
        "CollisionFreeSpeedModel",
        "`cfsm`",
        PEDESTRIAN_LAWS["cfsm"],
        {"T": 1.0, "l": 0.4, "a": 8.0, "D": 0.1},
        {"strength_neighbor_repulsion": 8.0, "range_neighbor_repulsion": 0.1},
        {"time_gap": 1.0, "desired_speed": _PACE, "radius": 0.2},
        preferred=True,
        parts=True,
    ),
}


def cases(kind: str, options: DiscoveryBenchmarkOptions, first: int) -> dict[str, Any]:
    """All cases of installed programs; nothing depends on the seeds."""
    return {
        f"recovery-{name}": {"name": name}
        for name, case in CASES.items()
        if find_spec(case.program.partition(",")[0].lower())
    }


def evaluate(name: str) -> dict[str, Any]:
    """The typed and the recovered parameters of a case."""
    case = CASES[name]
    with TemporaryDirectory() as folder:
        found = case.recovered(Path(folder))
    parameters = {
        "parameter": list(found.names),
        "typed in": found.typed.tolist(),
        "recovered, relative error": found.off.tolist(),
        "measured": found.measured.tolist(),
        "± 95 %": found.half.tolist(),
        "identified": found.identified.tolist(),
    }
    paths = {"paths, typed in (m)": found.forward, "paths, recovered (m)": found.path}
    return {"simulated by": case.program, "law here": case.law, **paths, "parameters": parameters}


def blocks(rows: list[dict[str, Any]]) -> list[Block]:
    """One line for each parameter."""
    heads = ["simulated by", "law here", "paths, typed in (m)", "paths, recovered (m)"]
    table = pd.concat(
        [pd.DataFrame({**{k: row[k] for k in heads}, **row["parameters"]}) for row in rows]
    )
    caption = "Paths: root mean square difference. The interval is that of positions with errors."
    return [
        Heading("Parameters that were typed in"),
        TableBlock("recovery", table.set_index("simulated by"), caption),
    ]
