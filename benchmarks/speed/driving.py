"""How many steps a second SUMO makes while a law of this package drives its vehicles.

Examples:
  python -m benchmarks.speed.driving
  python -m benchmarks.speed.driving --vehicles 100 --laws idm --programs libsumo

Platoons of twenty on roads of their own, one leader of SUMO's before each; 60 s in steps of 0.1 s.
Beside it the same vehicles with SUMO's own IDM, which nobody drives. The best of some repeats.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Iterator, Sequence
from itertools import product
from pathlib import Path
from typing import Any

import torch

from benchmarks.programs.sumo import network, sumo_home
from nnode.exchange.drive import drive
from nnode.exchange.running_sumo import RunningSumo
from nnode.files import write_json
from nnode.model import Traffic
from nnode.model.build import add_effects
from nnode.model.laws import CAR_FOLLOWING_LAWS, Law, law_from

#: Vehicles of a road, the step, s, and for how long, s.
PLATOON, STEP, SECONDS = 20, 0.1, 60.0


def system(name: str) -> Traffic:
    """``idm``; ``chained``: a law of first order that looks at the speed ahead in the same step."""
    if name == "idm":
        return Traffic([law_from("idm", CAR_FOLLOWING_LAWS["idm"])], leader="measured")
    chained = Traffic([Law("lin", v0=20.0, L=7.0)], leader="measured")
    add_effects(chained, [{"name": "relative_speed", "kappa": 0.3}])
    return chained


LAWS, OWN = ("idm", "chained"), "SUMO's"


def scene(folder: Path, number: int) -> Path:
    """Roads with platoons, ``number`` followers in all."""
    nodes, edges, routes, cars = "", "", "", ""
    for k in range(-(-number // PLATOON)):
        nodes += f'<node id="a{k}" x="0" y="{20 * k}"/><node id="b{k}" x="3000" y="{20 * k}"/>'
        edges += f'<edge id="e{k}" from="a{k}" to="b{k}" numLanes="1" speed="14"/>'
        routes += f'<route id="r{k}" edges="e{k}"/>'
        for i in range(min(PLATOON, number - k * PLATOON) + 1):
            kind = "own" if i else "lead"
            cars += (
                f'<vehicle id="{k}.{i}" type="{kind}" route="r{k}" depart="0" '
                f'departPos="{900 - 30 * i}" departSpeed="12" insertionChecks="none"/>'
            )
    types = (
        '<vType id="lead" speedDev="0" sigma="0"/>'
        '<vType id="own" carFollowModel="IDM" minGap="2" tau="1.2" accel="1.3" decel="1.7"/>'
    )
    (folder / "a.rou.xml").write_text(f"<routes>{types}{routes}{cars}</routes>")
    network(sumo_home(), folder, nodes, edges)
    scenario = folder / "a.sumocfg"
    scenario.write_text(
        '<configuration><input><net-file value="a.net.xml"/><route-files value="a.rou.xml"/>'
        f'</input><time><step-length value="{STEP}"/><end value="{SECONDS}"/></time>'
        '<report><no-warnings value="true"/></report></configuration>'
    )
    return scenario


def measured(law: str, program: str, scenario: Path) -> dict[str, Any]:
    """Steps per second while a law drives the vehicles, or SUMO itself."""
    folder = scenario.parent
    if law == OWN:
        sumo = RunningSumo(program, scenario, folder / "fcd.xml.gz")
        steps, start = 0, time.perf_counter()
        try:
            while sumo.continues(None):
                sumo.step()
                steps += 1
        finally:
            sumo.close()
        return {"steps": steps, "steps_per_s": steps / (time.perf_counter() - start)}
    driven = drive(system(law), scenario, ["own"], folder, program=program)
    return {
        "steps": driven.steps,
        "steps_per_s": driven.steps / driven.wall,
        "in_sumo": driven.in_sumo / driven.wall,
        "driven": driven.driven,
        "collisions": driven.collisions,
    }


def rows(
    numbers: Sequence[int], laws: Sequence[str], programs: Sequence[str], repeats: int
) -> Iterator[dict[str, Any]]:
    """The best of some repeats for every case."""
    for number in numbers:
        with tempfile.TemporaryDirectory() as folder:
            scenario = scene(Path(folder), number)
            for program, law in product(programs, (OWN, *laws)):
                repeated = [measured(law, program, scenario) for _ in range(repeats)]
                best = max(repeated, key=lambda row: row["steps_per_s"])
                yield {"vehicles": number, "program": program, "law": law, **best}


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--vehicles", nargs="+", type=int, default=[100, 1000])
    parser.add_argument("--laws", nargs="+", default=list(LAWS), choices=LAWS)
    parser.add_argument("--programs", nargs="+", default=["libsumo", "traci"])
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--out", type=Path, default=Path("runs/benchmark/driving.json"))
    asked = parser.parse_args()
    torch.set_num_threads(1)
    results = []
    for row in rows(asked.vehicles, asked.laws, asked.programs, asked.repeats):
        results.append(row)
        share = f", {100 * row['in_sumo']:.0f} % in SUMO" if "in_sumo" in row else ""
        print(
            f"{row['vehicles']} vehicles, {row['law']} law, {row['program']}: "
            f"{row['steps_per_s']:.0f} steps/s{share}",
            flush=True,
        )
    write_json(asked.out, {"rows": results})
    print(f"results: {asked.out}")


if __name__ == "__main__":
    main()
