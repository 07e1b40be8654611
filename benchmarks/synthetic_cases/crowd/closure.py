"""How much of the closable gap a diagnosis of a crowd closes, in the generator's own simulations.

Costs of a diagnosis depend on how it finds the states in which people start; here all models start
from the true states, and the diagnosis takes part with the coefficients that it reported.
"""

from __future__ import annotations

from typing import Any

from benchmarks.synthetic_cases.case import Case
from benchmarks.synthetic_cases.crowd.case import CrowdCase, Truth
from benchmarks.synthetic_cases.crowd.catalogue import EFFECTS
from benchmarks.synthetic_cases.crowd.motion import Base
from benchmarks.synthetic_cases.crowd.replay import Windows, cost_by_sequence

#: Effects with a number for every person: a report holds only their spread.
INDIVIDUAL = ("walker_heterogeneity", "gait_sway")
#: Parameters of the base law, and where a report tells them.
BASE = {name: f"social_force.{name}" for name in ("A", "k", "kappa")}


def crowd_costs(
    truth: dict[str, Any], report: dict[str, Any], sealed: list[int]
) -> tuple[float, float, float] | None:
    """Costs (m²) of the base model as calibrated, of the extended one and of the truth.

    Args:
        truth, report: as :func:`benchmarks.synthetic_cases.score.score` takes them.
        sealed: places of the sequences that count.

    Returns:
        None where the report lacks what a simulation needs.
    """
    named = {item["name"]: item["coefficients"] for item in report["effects"]}
    hidden = {item["name"] for item in truth["effects"]}
    if set(INDIVIDUAL) & (set(named) | hidden) or not set(named) <= set(EFFECTS):
        return None
    base_of = report.get("base") or {}
    parameters = {name: base_of[at] for name, at in BASE.items() if at in base_of}
    told = all(set(EFFECTS[name].fields.values()) <= set(values) for name, values in named.items())
    if not told or len(parameters) < len(BASE):
        return None
    case = Case.from_dict(truth["case"])
    effects = {
        item["name"]: {key: value["value"] for key, value in item["coefficients"].items()}
        for item in (*truth["effects"], *truth["outside"], *truth["nuisance"])
    }
    acts = Truth(effects, truth["noise"]["amplitude"], bell=case.variant == "smooth")
    made = CrowdCase(case, acts)
    scene = made.scene.only(sealed)
    x, v = made.simulate(acts, scene)
    windows = Windows(scene, x, v, x + case.sigma * scene.error, case.dt)

    def base(which: str) -> Base:
        return scene.base._replace(
            **{name: float(values[which]) for name, values in parameters.items()}
        )

    found = {
        name: {key: float(values[key]["value"]) for key in EFFECTS[name].fields.values()}
        for name, values in named.items()
    }
    costs = (
        windows.errors(base("before")),
        windows.errors(base("after"), Truth(found).hidden),
        windows.errors(scene.base, acts.hidden, eta=acts.eta),
    )
    before, after, best = (float(cost_by_sequence(error).mean()) for error in costs)
    return before, after, best
