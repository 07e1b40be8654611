"""The diagnosis of crowds where people differ: ``python -m benchmarks.people --seed N --cases K``.

Every case is ``--sequences`` sequences of 8 people who walk both ways through a corridor of 4.5 m,
measured for 6 s at 10 Hz, by the elliptical social force ``esf``, in which one effect is hidden or
none. Desired speeds and relaxation times are log-normal with a standard deviation of ``--spread``
%, pushes have a standard deviation of ``--push`` m/s² and last for ``--lasts`` s, and places are
measured with errors of 5 mm. With ``--turn``, their desired directions differ from that of their
stream, which the model is given in place of destinations. With ``--sway``, measured people sway as
they step, each with a size and a frequency of his own. With ``--nothing``, nothing is hidden in any
case, and with ``--effects`` one of the named effects in every case. Paths are integrated here;
everything else is the package's public interface. The cases of a run are fixed by its seed. The
table has a row per case; the last lines count right and false answers, with exact intervals of 95
%. Laws are not compared before a diagnosis; with ``--default`` they are, as in every diagnosis by
default.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pandas as pd

import nnode
from benchmarks.drivers import estimate_row, run_cases
from benchmarks.synthetic_cases.score import judged
from nnode.app.python.inputs import model_options
from nnode.diagnosis.options import DiscoverOptions
from studies.runner import Task

#: Sampling interval and step, s; samples; s for which people walk before they are measured, so that
#: speeds at the start depend on pushes.
DT, STEP, SAMPLES, BEFORE = 0.1, 0.02, 61, 2.0
PEOPLE, RADIUS, ERROR = 8, 0.25, 0.005
#: Width and half the length of the corridor, m, which nobody leaves; distance of destinations, m.
WIDTH, HALF, FAR = 4.5, 30.0, 1000.0
WALLS = pd.DataFrame(
    [(-HALF, 0.0, HALF, 0.0), (HALF, WIDTH, -HALF, WIDTH)], columns=["x1", "y1", "x2", "y2"]
)
#: Typical desired speed, m/s, and relaxation time, s. A and B of walls, m/s² and m.
SPEED, TAU, A_W, B_W = 1.3, 0.5, 5.0, 0.1
#: Other parameters of the law.
LAW = {"A": 2.5, "B": 0.35, "stride": 0.5, "lam": 0.3}
#: Hidden effects: the name of the size, the size, other settings.
HIDDEN: dict[str, tuple[str, float, dict[str, float]]] = {
    "alignment": ("c", 0.15, {}),
    "density_slowdown": ("c", 0.5, {}),
    "pair_repulsion": ("A_2", 0.35, {"B_2": 0.8}),
    "drift": ("a_y", -0.15, {"a_x": 0.0}),
    "sliding_friction": ("c", 0.3, {}),
    "obstacle": ("A_o", 3.0, {"B_o": 0.5, "x_o": 0.0, "y_o": WIDTH / 2}),
}
#: Mean frequency of strides, of two steps each, Hz.
STRIDES = 0.9
#: Accelerations ``(S, N, 2)`` as a function of positions and velocities.
Rate = Callable[[np.ndarray, np.ndarray], np.ndarray]


def crowds(
    effect: str,
    seed: int,
    *,
    spread: float = 0.15,
    push: float = 0.1,
    lasts: float = 4.0,
    turn: float = 0.0,
    sway: float = 0.0,
    sequences: int = 24,
) -> pd.DataFrame:
    """A tidy table of measured positions and destinations, m, and of desired directions, rad.

    Args:
        effect: a name of :data:`HIDDEN`, or ``none``.
        spread: standard deviation of logarithms of desired speeds and relaxation times.
        push: standard deviation of accelerations that last for ``lasts`` s, m/s².
        turn: standard deviation of desired directions, rad.
        sway: standard deviation of measured positions across the corridor by people's steps, m.
    """
    draw, shape = np.random.default_rng(seed), (sequences, PEOPLE)
    way = np.where(np.arange(PEOPLE) % 2, 1.0, -1.0)
    lanes = draw.permuted(np.tile(np.linspace(0.6, WIDTH - 0.6, PEOPLE), (sequences, 1)), axis=1)
    x = np.stack([-way * draw.uniform(1.0, 5.0, shape), lanes], -1)
    speed, tau = (m * np.exp(spread * draw.normal(size=(*shape, 1))) for m in (SPEED, TAU))
    angle = turn * draw.normal(size=shape) if turn else np.zeros(shape)
    wanted = speed * np.stack([way * np.cos(angle), np.sin(angle)], -1)
    v, path = wanted.copy(), []
    keep, acting = np.exp(-STEP / lasts), push * draw.normal(size=(*shape, 2))
    hidden = _hidden(effect)

    def rate(x: np.ndarray, v: np.ndarray) -> np.ndarray:
        return (wanted - v) / tau + _by_others(x, v) + _by_walls(x) + hidden(x, v) + acting

    every = round(DT / STEP)
    for k in range(-round(BEFORE / STEP), (SAMPLES - 1) * every + 1):
        if k >= 0 and k % every == 0:
            path.append(x)
        # the midpoint rule; pushes are constant during a step
        middle = v + STEP / 2 * rate(x, v)
        x, v = x + STEP * middle, v + STEP * rate(x + STEP / 2 * v, middle)
        fresh = push * np.sqrt(1 - keep**2)
        acting = keep * acting + fresh * draw.normal(size=acting.shape)
    measured = np.array(path) + ERROR * draw.normal(size=(SAMPLES, *x.shape))
    if sway:
        measured += _swaying(sway, draw, shape)
    samples, s, i = (axis.ravel() for axis in np.indices(measured.shape[:3]))
    return pd.DataFrame(
        {
            "sequence": [f"s{number:03d}" for number in s],
            "time": (DT * samples + 100.0 * s).round(3),
            "agent": [f"{a}-{b}" for a, b in zip(s, i, strict=True)],
            "x": measured[..., 0].ravel(),
            "y": measured[..., 1].ravel(),
            "dest_x": FAR * way[i],
            "dest_y": measured[0, s, i, 1],
            "angle": angle[s, i],
        }
    )


def spread_in_streams(table: pd.DataFrame, turn: float) -> float:
    """Standard deviation of desired directions about those of the streams, rad.

    A stream's direction is that of the mean velocity of its people. Others, walls and pushes turn
    it away from the mean of their desired directions.

    Args:
        table: of :func:`crowds`. turn: standard deviation of desired directions, rad.
    """
    person = table.groupby(["sequence", "agent"])
    people = (person[["x", "y"]].last() - person[["x", "y"]].first()).join(person["angle"].first())
    streams = people.assign(along=np.abs(people["x"])).groupby(["sequence", people["x"] > 0])
    mean = streams[["along", "y", "angle"]].mean()
    turned = np.arctan2(mean["y"], mean["along"]) - mean["angle"]
    # a stream has half of the people
    return float(np.sqrt(turn**2 * (1 - 2 / PEOPLE) + (turned**2).mean()))


def _swaying(size: float, draw: np.random.Generator, shape: tuple[int, int]) -> np.ndarray:
    """``(T, S, N, 2)`` m: across the corridor once in two steps, with a third harmonic, and along
    it with every step."""
    sizes = size * np.sqrt(2) * np.exp(0.3 * draw.normal(size=shape))
    frequency = STRIDES * np.exp(0.08 * draw.normal(size=shape))
    time = DT * np.arange(SAMPLES)[:, None, None]

    def oscillation(harmonic: int, share: float) -> np.ndarray:
        phase = draw.uniform(0, 2 * np.pi, shape)
        return np.asarray(share * sizes * np.sin(2 * np.pi * harmonic * frequency * time + phase))

    along, across = oscillation(2, 0.3), oscillation(1, 1.0) + oscillation(3, 0.07)
    return np.stack([along, across], -1)


def _length(vectors: np.ndarray) -> np.ndarray:
    return np.asarray(np.sqrt((vectors**2).sum(-1) + 1e-12))


def _pairs(x: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, ...]:
    """Positions and velocities relative to each other ``(S, N, N, 2)``, distances, and 1 where the
    other is somebody else."""
    dx, dv = (a[:, :, None] - a[:, None] for a in (x, v))
    return dx, dv, _length(dx), 1 - np.eye(x.shape[1])


def _by_others(x: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Source: Johansson, Helbing & Shukla 2007; A is the acceleration straight ahead at b = 2 r."""
    dx, dv, d, other = _pairs(x, v)
    then = dx + LAW["stride"] * dv
    d_then = _length(then)
    step = LAW["stride"] ** 2 * (dv**2).sum(-1)
    b = np.sqrt(np.maximum(((d + d_then) ** 2 - step) / 4, 0.05**2))
    cosine = -((v / _length(v)[..., None])[:, :, None] * dx / d[..., None]).sum(-1)
    view = LAW["lam"] + (1 - LAW["lam"]) * (1 + cosine) / 2
    size = view * LAW["A"] * np.exp((2 * RADIUS - b) / LAW["B"]) * (d + d_then) / (4 * b)
    push = (size * other)[..., None] * (dx / d[..., None] + then / d_then[..., None])
    return np.asarray(push.sum(2))


def _by_walls(x: np.ndarray) -> np.ndarray:
    out = np.zeros_like(x)
    for place, sign in ((0.0, 1.0), (WIDTH, -1.0)):
        out[..., 1] += sign * A_W * np.exp((RADIUS - sign * (x[..., 1] - place)) / B_W)
    return out


def _hidden(effect: str) -> Rate:
    """The accelerations by a hidden effect; the formulas are those of ``docs/discovery.md``."""
    if effect == "none":
        return lambda x, v: np.zeros_like(x)
    _, size, settings = HIDDEN[effect]

    def alignment(x: np.ndarray, v: np.ndarray) -> np.ndarray:
        _, dv, d, other = _pairs(x, v)
        weight = np.exp(-d / 2.0) * other
        pull = -(weight[..., None] * dv).sum(2) / weight.sum(2)[..., None]
        return np.asarray(size * pull)

    def density_slowdown(x: np.ndarray, v: np.ndarray) -> np.ndarray:
        _, _, d, other = _pairs(x, v)
        density = (np.exp(-(d**2) / 2) / (2 * np.pi) * other).sum(2)
        return np.asarray(-size * density[..., None] * v)

    def pair_repulsion(x: np.ndarray, v: np.ndarray) -> np.ndarray:
        dx, _, d, other = _pairs(x, v)
        push = size * np.exp((2 * RADIUS - d) / settings["B_2"]) * other / d
        return np.asarray((push[..., None] * dx).sum(2))

    def drift(x: np.ndarray, v: np.ndarray) -> np.ndarray:
        return np.broadcast_to([settings["a_x"], size], x.shape)

    def sliding_friction(x: np.ndarray, v: np.ndarray) -> np.ndarray:
        dx, dv, d, other = _pairs(x, v)
        n_x, n_y = np.moveaxis(dx / d[..., None], -1, 0)
        slip = dv[..., 0] * n_y - dv[..., 1] * n_x
        slide = size * np.exp((2 * RADIUS - d) / 0.5) * slip * other
        return np.stack([-(slide * n_y).sum(2), (slide * n_x).sum(2)], -1)

    def obstacle(x: np.ndarray, v: np.ndarray) -> np.ndarray:
        away = x - [settings["x_o"], settings["y_o"]]
        far = _length(away)[..., None]
        return np.asarray(size * np.exp(-far / settings["B_o"]) * away / far)

    rates: dict[str, Rate] = {
        "alignment": alignment,
        "density_slowdown": density_slowdown,
        "pair_repulsion": pair_repulsion,
        "drift": drift,
        "sliding_friction": sliding_friction,
        "obstacle": obstacle,
    }
    return rates[effect]


def cases(
    seed: int, total: int, effects: list[str] | None = None, nothing: bool = False, **given: Any
) -> list[dict[str, Any]]:
    """Half of them with nothing hidden; effects take turns.

    Args:
        effects: hidden in all cases; None: half of the cases.
        nothing: hidden in all cases.
        given: other arguments of :func:`crowds`.
    """
    chosen, names = [], list(HIDDEN) if effects is None else effects
    for k in range(total):
        hides = not nothing and (effects is not None or k % 2 == 1)
        turn = k if effects is not None else k // 2
        effect = names[turn % len(names)] if hides else "none"
        chosen.append({"effect": effect, "seed": seed + k} | given)
    return chosen


def evaluate(laws: list[str] | None, **case: Any) -> dict[str, Any]:
    """A diagnosis, and intervals of sizes and of differences between people.

    Args:
        laws: the laws that are compared first; None takes those of diagnoses by default.
    """
    start = time.monotonic()
    with TemporaryDirectory() as folder:
        walls = Path(folder) / "walls.csv"
        WALLS.to_csv(walls, index=False)
        table = crowds(**case)
        report = nnode.diagnose(
            table.drop(columns="angle"),
            "crowd",
            model={**model_options("esf"), "desired": "direction" if case["turn"] else "exit"},
            options=DiscoverOptions(page=False, replay=False, compare=laws),
            walls=walls,
        ).plain()
    hidden = case["effect"] != "none"
    row = {**case, "hidden": hidden, **judged(report, [case["effect"]] if hidden else [])}
    true = {
        "desired_speed": 100 * case["spread"],
        "tau": 100 * case["spread"],
        "push": case["push"],
        "push_time": case["lasts"],
    }
    if case["turn"]:
        true["desired_direction"] = spread_in_streams(table, case["turn"])
    variations = {each["name"]: each for each in report["drivers"]}
    for name, value in true.items():
        each = variations.get(name, {})
        row |= estimate_row(name, value, *(each.get(end) for end in ("estimate", "lower", "upper")))
    if hidden:
        key, size, _ = HIDDEN[case["effect"]]
        effects = {effect["name"]: effect["coefficients"] for effect in report["effects"]}
        found = effects.get(case["effect"], {}).get(key, {})
        row |= estimate_row("size", size, *(found.get(end) for end in ("value", "low", "high")))
    return {**row, "seconds": round(time.monotonic() - start, 1)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seed", type=int, required=True, help="of the first case")
    for name, default, text in (
        ("cases", 24, "number of cases"),
        ("spread", 15.0, "between people, percent"),
        ("push", 0.1, "standard deviation of pushes, m/s²"),
        ("lasts", 4.0, "of pushes, s"),
        ("turn", 0.0, "standard deviation of desired directions, rad"),
        ("sway", 0.0, "of people who step, standard deviation across the corridor, m"),
        ("sequences", 24, "in a case"),
        ("processes", 2, "side by side"),
    ):
        parser.add_argument(f"--{name}", type=type(default), default=default, help=text)
    parser.add_argument("--effects", nargs="+", choices=list(HIDDEN), help="hidden in all cases")
    parser.add_argument("--nothing", action="store_true", help="nothing hidden in any case")
    parser.add_argument("--default", action="store_true", help="compare laws first")
    parser.add_argument("--table", type=Path, default=Path("runs/benchmark_people.csv"))
    given = parser.parse_args()
    chosen = cases(
        given.seed,
        given.cases,
        given.effects,
        given.nothing,
        spread=given.spread / 100,
        push=given.push,
        lasts=given.lasts,
        turn=given.turn,
        sway=given.sway,
        sequences=given.sequences,
    )
    laws: list[str] | None = None if given.default else []
    tasks = [
        Task(f"esf-{case['effect']}-s{case['seed']}", evaluate, case | {"laws": laws})
        for case in chosen
    ]
    run_cases(tasks, given.table, given.processes, ["hidden"])


if __name__ == "__main__":
    # worker processes import the functions by the name of this module
    from benchmarks import people

    people.main()
