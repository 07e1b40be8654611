"""Parameters that are typed into SUMO and JuPedSim, recovered from what the programs simulate."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, cast

import numpy as np
import pandas as pd
import torch
import yaml
from scipy.optimize import minimize

from benchmarks.config import DiscoveryBenchmarkOptions
from benchmarks.programs import jupedsim as people
from benchmarks.programs import sumo
from benchmarks.programs.laws import LAWS
from nnode.calibrate.least_squares import Minimum
from nnode.calibrate.problem import ResidualProblem, pooled
from nnode.data.readers.sumo import SumoOptions, read_sumo
from nnode.data.sequence import Batch, Sequence, collate
from nnode.model import Crowd, Traffic
from nnode.model.laws import CAR_FOLLOWING_LAWS, PEDESTRIAN_LAWS, law_from
from nnode.model.system import System
from nnode.simulation.fused import FusedSolver

#: By name, see ``recovery.yaml``.
CASES: dict[str, dict[str, Any]] = yaml.safe_load(
    Path(__file__).with_suffix(".yaml").read_text(encoding="utf-8")
)
#: SUMO's names of the parameters.
_SUMO = {"v0": "maxSpeed", "T": "tau", "s0": "minGap", "a": "accel", "b": "decel"}
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


def cases(kind: str, options: DiscoveryBenchmarkOptions, first: int) -> dict[str, Any]:
    """All cases of installed programs; nothing depends on the seeds."""
    return {
        f"recovery-{name}": {"name": name}
        for name, case in CASES.items()
        if find_spec(case["simulated"].partition(",")[0].lower())
    }


def evaluate(name: str) -> dict[str, list[dict[str, Any]]]:
    """A row per parameter of a case."""
    found, case = recovered(name), CASES[name]
    row: dict[str, Any] = {
        "simulated by": case["simulated"],
        "law here": case["here"],
        "paths, typed in (m)": found.forward,
        "paths, recovered (m)": found.path,
    }
    parameters = found.parameters.reset_index(names="parameter")
    away = (parameters["measured"] - parameters["typed"]).abs()
    parameters["covered"] = away < parameters["half"]
    return {"recovery": cast(list[dict[str, Any]], parameters.assign(**row).to_dict("records"))}


def recovered(name: str) -> Recovered:
    """Simulate a case with its program, and calibrate the law to the paths."""
    case = CASES[name]
    law = {**CAR_FOLLOWING_LAWS, **PEDESTRIAN_LAWS, **LAWS}[case["law"]]
    with TemporaryDirectory() as folder:
        if "follow" in case:
            method = "ballistic" if case.get("ballistic") else "semi_implicit"
            platoon = _by_sumo(Path(folder), case)
            return recover(law, case["typed"], [platoon], dt=sumo.STEP, method=method, error=ROAD)
        sequences = [part for seed in range(2) for part in _by_jupedsim(Path(folder), case, seed)]
        return recover(law, case["typed"], sequences, dt=people.STEP, error=ROOM)


def _by_sumo(folder: Path, case: dict[str, Any]) -> Sequence:
    values = {_SUMO[name]: value for name, value in case["typed"].items()}
    values |= {"emergencyDecel": case.get("emergency", 9.0)}
    path = sumo.platoon(
        sumo.sumo_home(),
        folder,
        case["follow"],
        values if case["follow"] == "IDM" else values | {"sigma": 0.0},
        ballistic=case.get("ballistic", False),
        profile=sumo.SLOWLY if case.get("slowly") else sumo.PROFILE,
    )
    (platoon,) = read_sumo(path, SumoOptions(path=str(path), dt=sumo.STEP))
    # SUMO does not write lengths
    return replace(platoon, length=np.full(platoon.n_agents, sumo.LENGTH))


def _by_jupedsim(folder: Path, case: dict[str, Any], seed: int) -> list[Sequence]:
    jupedsim = import_module("jupedsim")
    walked = people.groups(
        jupedsim,
        folder / f"{seed}.sqlite",
        getattr(jupedsim, case["kind"])(**case["model"]),
        getattr(jupedsim, f"{case['kind']}AgentParameters"),
        case["person"],
        seed=seed,
        **case["groups"],
    )
    if case.get("preferred"):
        assert walked.destination is not None
        pace = np.array([[case["person"]["desired_speed"], 0.0]])
        walked = replace(walked, preferred=np.sign(walked.destination[:, :1]) * pace)
    return people.pieces(walked, case["pieces"]) if "pieces" in case else [walked]


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
    count = int(moves.sum())
    exact = _metres(problem, truth)[0][moves]
    turns, one = (-1.0) ** np.arange(len(truth)), np.ones(len(truth))
    # a limit on speed or acceleration that is nowhere reached changes nothing: of these starts
    # some lie below each
    starts = [truth * (1 + AWAY * way) for way in (turns, -turns, one, -one)]
    ends = [_best(problem, start) for start in starts]
    paths = np.array([np.sqrt((_metres(problem, end.row)[0] ** 2).sum() / count) for end in ends])
    best = ends[int(np.argmin(paths))]
    rows = np.array([end.row for end in ends])[paths < paths.min() + ROUNDED]
    agreed = np.ptp(rows, axis=0) < WIDE * np.abs(truth)
    noise, later = np.zeros(batch.x.shape), batch.valid.numpy().copy()
    later[0] = False
    noise[later] = np.random.default_rng(seed).standard_normal((later.sum(), batch.x.shape[-1]))
    noise *= error * moves.reshape(noise.shape)
    noisy = ResidualProblem(system, replace(batch, x=batch.x - torch.from_numpy(noise)), solver)
    end = min((_best(noisy, start) for start in starts), key=lambda end: float(end.cost))
    left, slopes = _metres(noisy, end.row)
    scale = np.sqrt((left**2).sum() / (count - len(truth)))
    half = np.where(agreed, NORMAL * scale * _standard_errors(slopes[moves]), np.inf)
    parameters = pd.DataFrame(
        {
            "typed": truth,
            "found": best.row,
            "off": np.abs(best.row - truth) / np.abs(truth),
            "measured": end.row,
            "half": half,
            "identified": half < WIDE * np.abs(end.row),
        },
        index=[name.rpartition(".")[2] for name in problem.names],
    )
    return Recovered(
        parameters=parameters,
        forward=float(np.sqrt((exact**2).sum() / count)),
        worst=float(np.abs(exact).max()),
        path=float(paths.min()),
    )


def _system(law: Mapping[str, Any], typed: Mapping[str, float], dim: int) -> System:
    term = law_from("law", law)
    system: System = Traffic([term], leader="measured") if dim == 1 else Crowd([term])
    system.double()
    with torch.no_grad():
        for name, parameter in term.named_parameters():
            parameter.requires_grad_(name in typed)
            if name in typed:
                parameter.fill_(typed[name])
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
