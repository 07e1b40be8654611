"""Does the advice help: are delay and inertia told apart by the platoons that a report asks for?

``python -m benchmarks.discovery.advice FOLDER --seeds-of HASH``. Drivers react late, or slowly, to
the gap; where a diagnosis of forty platoons cannot tell which, as many platoons as it asks for
follow its leader, and as many the random leaders of before, for the same time. Both are diagnosed
together with the first ones. Vehicles are moved by what is written here.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import binomtest

from benchmarks.discovery.task import sources
from benchmarks.synthetic_cases.arms import first_seed
from studies.runner import Task, run_tasks

#: Samples' distance and Euler's steps, s; time before the first sample, s; vehicles, platoons.
DT, STEP, BEFORE, VEHICLES, FIRST = 0.2, 0.02, 30.0, 5, 40
#: Standard deviation (m/s) and time (s) of disturbances; errors of positions, m; time seen, s.
PUSH, LASTS, NOISE, SECONDS = 0.3, 3.0, 0.05, 30.0
#: No more platoons than this are driven, for time.
MOST = 120
NAMES = ("reaction_delay", "inertia")


def driven(rng: np.random.Generator, truth: dict[str, Any], speed: np.ndarray) -> np.ndarray:
    """``(P, K, N)`` measured places, m, behind leaders' speeds ``(P, steps)``, m/s."""
    steps = speed.shape[1]
    lead = np.cumsum(speed, 1) * STEP
    gap = truth["L"] * truth["v0"] / (truth["v0"] - speed[:, :1])
    x = lead[:, :1] - gap * np.arange(VEHICLES - 1, 0, -1)
    late = round(truth["value"] / STEP) if truth["name"] == NAMES[0] else 0
    tau = truth["value"] if truth["name"] == NAMES[1] else None
    v = np.repeat(speed[:, :1], VEHICLES - 1, 1)
    push, keep = np.zeros_like(x), np.exp(-STEP / LASTS)
    gaps, seen = [], []
    for k in range(steps):
        every = np.concatenate([x, lead[:, k : k + 1]], 1)
        seen.append(every)
        gaps.append(np.diff(every, axis=1))
        wanted = truth["v0"] * (1 - truth["L"] / gaps[max(k - late, 0)])
        push = keep * push + PUSH * np.sqrt(1 - keep**2) * rng.normal(size=x.shape)
        v = wanted if tau is None else v + STEP / tau * (wanted - v)
        x = x + STEP * (v + push)
    kept = np.stack(seen, 1)[:, round(BEFORE / STEP) :: round(DT / STEP)]
    return np.asarray(kept + rng.normal(0, NOISE, kept.shape))


def random_speeds(rng: np.random.Generator, number: int) -> np.ndarray:
    """Leaders' speeds ``(P, steps)``, m/s: slow waves of random size and period."""
    t = STEP * np.arange(round((BEFORE + SECONDS) / STEP) + 1)
    size, period, turn = (
        rng.uniform(low, high, (3, number, 1)) for low, high in ((0.3, 1.5), (8, 40), (0, 6.3))
    )
    return np.asarray(16 + (size * np.sin(2 * np.pi * t / period + turn)).sum(0))


def advised_speeds(profile: Any, number: int) -> np.ndarray:
    """The same of leaders who follow an advice."""
    t = STEP * np.arange(round((BEFORE + SECONDS) / STEP) + 1)
    later = np.maximum(t - BEFORE, 0.0)
    one = profile.mean + profile.swing * np.sin(2 * np.pi * later / profile.period)
    return np.repeat(one[None], number, 0)


def case(seed: int, name: str) -> dict[str, Any]:
    """One truth: what the first diagnosis says, and the later ones."""
    from nnode.data.sequence import Sequence
    from nnode.discover.diagnose import diagnose
    from nnode.discover.options import DiscoverOptions
    from nnode.model.build import build_model

    rng = np.random.default_rng([seed, NAMES.index(name)])
    truth = {
        "name": name,
        "value": float(rng.uniform(0.4, 0.8)),
        "v0": float(rng.uniform(26, 32)),
        "L": float(rng.uniform(5, 7)),
    }
    options = DiscoverOptions(effects=list(NAMES), structure=False, compare=[])
    law = {"term": "lin", "name": "lin", "leader": "measured", "v0": 28.0, "L": 6.0, "L_min": 1.0}

    def verdict(runs: np.ndarray) -> Any:
        time = DT * np.arange(runs.shape[1])
        sequences = [
            Sequence(name=f"r/{i}", recording="r", time=time + 100.0 * i, x=x[..., None])
            for i, x in enumerate(runs)
        ]
        return diagnose(build_model(law), sequences, options).diagnosis

    first = driven(rng, truth, random_speeds(rng, FIRST))
    said = verdict(first)
    found: dict[str, Any] = {**truth, "seed": seed, "verdict": said.verdict}
    found["named"] = [one.name for one in said.effects]
    others = [o for one in said.effects for o in one.alternatives if o.profile is not None]
    if said.verdict != "indistinguishable" or not others:
        return found
    profile = others[0].profile
    # the advice counts open platoons
    number = min(round(profile.platoons / (1 - options.sealed)), MOST)
    found |= {"platoons": profile.platoons, "swing": profile.swing, "period": profile.period}
    for how, speeds in (
        ("advised", advised_speeds(profile, number)),
        ("random", random_speeds(rng, number)),
    ):
        again = verdict(np.concatenate([first, driven(rng, truth, speeds)]))
        found[how] = [again.verdict, *(one.name for one in again.effects)]
    return found


def main() -> None:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.discovery.advice", description=__doc__
    )
    parser.add_argument("folder", type=Path)
    parser.add_argument("--seeds-of", help="full hash of a commit")
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--number", type=int, default=10, help="cases of delay, and of inertia")
    parser.add_argument("--workers", type=int, default=1)
    given = parser.parse_args()
    seed = given.first_seed if given.seeds_of is None else first_seed(given.seeds_of)
    tasks = [
        Task(f"{name}-s{seed + i}", case, {"seed": seed + i, "name": name})
        for i in range(given.number)
        for name in NAMES
    ]
    results = run_tasks(
        tasks, given.folder, workers=given.workers, fingerprint=sources(), title="cases"
    )
    rows = list(results.values())
    for row in rows:
        print(row)
    right = sum(row["verdict"] == "named" and row["named"] == [row["name"]] for row in rows)
    asked = [row for row in rows if "advised" in row]
    print(f"{len(rows)} cases: {right} told at once, {len(asked)} ask for more")
    for how in ("advised", "random"):
        told = sum(row[how] == ["named", row["name"]] for row in asked)
        wrong = sum(row[how][0] == "named" and row[how] != ["named", row["name"]] for row in asked)
        ends = ""
        if asked:
            low, high = binomtest(told, len(asked)).proportion_ci(method="exact")
            ends = f" ({100 * low:.0f}-{100 * high:.0f} %)"
        print(f"{how}: {told} of {len(asked)} told rightly{ends}, {wrong} wrongly")


if __name__ == "__main__":
    main()
