"""Parameters that are typed into SUMO and JuPedSim, recovered from what the programs simulate."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, cast

import numpy as np
import pandas as pd
import torch
from scipy.optimize import minimize

from benchmarks.config import DiscoveryBenchmarkOptions
from benchmarks.programs import jupedsim as people
from benchmarks.programs import laws, sumo
from nnode.calibrate.least_squares import Minimum
from nnode.calibrate.problem import ResidualProblem, pooled
from nnode.data.readers.sumo import SumoOptions, read_sumo
from nnode.data.sequence import Batch, Sequence, collate
from nnode.model import Crowd, Traffic
from nnode.model.laws import CAR_FOLLOWING_LAWS, PEDESTRIAN_LAWS, law_from
from nnode.model.system import System
from nnode.simulation.fused import FusedSolver

#: SUMO's names of the parameters.
_SUMO = {"v0": "maxSpeed", "T": "tau", "s0": "minGap", "a": "accel", "b": "decel"}
_IDM = {"v0": 28.0, "T": 1.1, "s0": 2.3, "a": 1.4, "b": 2.0}
_KRAUSS = {"v0": 21.0, "T": 1.1, "s0": 2.3, "a": 1.9, "b": 3.5}
#: JuPedSim's people: mass, kg, desired speed, m/s, time to reach it, s.
_MASS, _PACE, _TAU = 80.0, 1.3, 0.5
_TOUCH = {"A": 2.0, "B": 0.3, "k": 150.0, "kappa": 50.0, "v0": _PACE, "tau": _TAU}
#: Errors of measured positions, m: of vehicles, of people.
ROAD, ROOM = 0.1, 0.01
#: The searches start this share away from every parameter: up and down in turns, all up, all down.
AWAY = 0.3
#: Half an interval of 95 %, in standard errors.
NORMAL = 1.96
#: A parameter whose interval is wider to one side than this share of it is not identified.
WIDE = 0.1
#: m: what rounding in the other program's files may do. Searches that end this close to the best
#: one are equally good, and a parameter on which they disagree is not identified.
ROUNDED = 1e-9


@dataclass(frozen=True, kw_only=True)
class Recovered:
    """One law of another program, calibrated to its output.

    Attributes:
        parameters: a row per parameter. ``typed``: what was typed in; ``found``: where the search
            ended, and ``off`` its relative error; ``measured``: where it ends if positions have
            independent normal errors; ``half``: half the 95 % interval around ``measured``, by its
            residuals, infinite where nothing depends on the parameter; ``identified``: whether the
            interval is narrow.
        forward, worst: root mean square and largest difference of a coordinate, m, with the typed
            parameters.
        path: root mean square with those found.
    """

    parameters: pd.DataFrame
    forward: float
    worst: float
    path: float


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


def evaluate(name: str) -> dict[str, list[dict[str, Any]]]:
    """A row per parameter of a case."""
    case = CASES[name]
    with TemporaryDirectory() as folder:
        found = case.recovered(Path(folder))
    row: dict[str, Any] = {
        "simulated by": case.program,
        "law here": case.law,
        "paths, typed in (m)": found.forward,
        "paths, recovered (m)": found.path,
    }
    parameters = found.parameters.reset_index(names="parameter")
    parameters["covered"] = (parameters["measured"] - parameters["typed"]).abs() < parameters[
        "half"
    ]
    return {"recovery": cast(list[dict[str, Any]], parameters.assign(**row).to_dict("records"))}


def recover(
    law: Mapping[str, Any],
    typed: Mapping[str, float],
    sequences: list[Sequence],
    *,
    dt: float,
    method: str | None = None,
    error: float = 0.1,
    seed: int = 0,
) -> Recovered:
    """Calibrate a law to another program's paths from starts that are off in every parameter.

    Args:
        law: its description; leaders of lanes drive as they did.
        typed: parameter of the law to what was typed into the other program, SI units. Others
            keep the values of the description.
        dt: step, s.
        method: of lanes; see :data:`nnode.model.steps.METHODS`.
        error: of measured positions, m. The first state and the leader keep theirs, so that the
            errors are independent and the intervals those of the textbook.
        seed: of these errors.
    """
    batch = collate(sequences)
    system = _system(law, typed, batch.x.shape[-1])
    solver = FusedSolver(dt=dt, method=method)
    problem = ResidualProblem(system, batch, solver)
    truth = problem.vector.row.numpy()
    moves = _moving(system, batch)
    exact = _metres(problem, truth)[0][moves]
    turns, one = (-1.0) ** np.arange(len(truth)), np.ones(len(truth))
    # a limit on speed or acceleration that is nowhere reached changes nothing: of these starts
    # some lie below each
    starts = [truth * (1 + AWAY * way) for way in (turns, -turns, one, -one)]
    ends = [_best(problem, start) for start in starts]
    paths = [np.sqrt((_metres(problem, end.row)[0] ** 2).sum() / moves.sum()) for end in ends]
    best = ends[int(np.argmin(paths))]
    alike = np.array(
        [end.row for end, path in zip(ends, paths, strict=True) if path < min(paths) + ROUNDED]
    )
    agreed = np.ptp(alike, axis=0) < WIDE * np.abs(truth)
    noise, later = np.zeros(batch.x.shape), batch.valid.numpy().copy()
    later[0] = False
    noise[later] = np.random.default_rng(seed).standard_normal((later.sum(), batch.x.shape[-1]))
    noise *= error * moves.reshape(noise.shape)
    measured = replace(batch, x=batch.x - torch.from_numpy(noise))
    noisy = ResidualProblem(system, measured, solver)
    again = min((_best(noisy, start) for start in starts), key=lambda end: float(end.cost))
    count = int(moves.sum())
    left, slopes = _metres(noisy, again.row)
    half = (
        NORMAL * np.sqrt((left**2).sum() / (count - len(truth))) * _standard_errors(slopes[moves])
    )
    half = np.where(agreed, half, np.inf)
    parameters = pd.DataFrame(
        {
            "typed": truth,
            "found": best.row,
            "off": np.abs(best.row - truth) / np.abs(truth),
            "measured": again.row,
            "half": half,
            "identified": half < WIDE * np.abs(again.row),
        },
        index=[name.rpartition(".")[2] for name in problem.names],
    )
    return Recovered(
        parameters=parameters,
        forward=float(np.sqrt((exact**2).sum() / count)),
        worst=float(np.abs(exact).max()),
        path=float(min(paths)),
    )


def _system(law: Mapping[str, Any], typed: Mapping[str, float], dim: int) -> System:
    term = law_from("law", law)
    system: System = Traffic([term], leader="measured") if dim == 1 else Crowd([term])
    system.double()
    with torch.no_grad():
        for name, value in typed.items():
            getattr(term, name).fill_(value)
    for name, parameter in term.named_parameters():
        parameter.requires_grad_(name in typed)
    return system


def _metres(problem: ResidualProblem, row: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """``(M,)`` differences of coordinates, m, and their ``(M, K)`` derivatives."""
    _, away, slope = problem.linearised(row)
    return away.numpy().ravel(), slope.flatten(1).T.numpy()


def _moving(system: System, batch: Batch) -> np.ndarray:
    """``(M,)`` which of them are of agents that the model moves, after the first sample."""
    given = system.given(batch)
    moves = batch.valid.clone() if given is None else batch.valid & ~given
    moves[0] = False
    return moves[..., None].expand(batch.x.shape).flatten().numpy()


def _best(problem: ResidualProblem, start: np.ndarray) -> Minimum:
    """Where the search ends.

    Paths of people have jumps in the parameters, where someone else comes nearest: derivatives lead
    close to a minimum, and a search without them ends in it.
    """
    first = pooled(problem, problem.initial_fit(start), steps=60, tolerance=1e-9)
    by_simplex = minimize(
        lambda share: float(problem.costs(first.row * share).mean()),
        np.ones(len(start)),
        method="Nelder-Mead",
        bounds=list(zip(problem.low / first.row, problem.high / first.row, strict=True)),
        options={
            "initial_simplex": 1 + WIDE / 5 * np.eye(len(start) + 1, len(start)),
            "xatol": 1e-12,
            "fatol": 0.0,
            "maxfev": 1000,
        },
    )
    return pooled(problem, first.row * by_simplex.x, steps=10, tolerance=1e-9)


def _standard_errors(slopes: np.ndarray) -> np.ndarray:
    """``(K,)`` standard errors by residuals of 1 m, infinite where a parameter changes nothing."""
    size = np.linalg.norm(slopes, axis=0)
    live = size > 1e-9
    scaled = slopes[:, live] / size[live]
    found = np.full(len(size), np.inf)
    found[live] = np.sqrt(np.diag(np.linalg.pinv(scaled.T @ scaled))) / size[live]
    return found
