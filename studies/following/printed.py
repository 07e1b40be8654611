"""Published figures of car following, with the parameters and conventions that they belong to.

Source: the replication package "Segment-based versus Sample-based Calibration of Car-Following
Dynamics", github.com/TeRyZh/Segment-based-Calibration-of-Car-Following-Dynamics, commit
89f4f0c2fc4bfe1d975c70c7ce681d080a16f19c, ``experiment_out_{idm,gipps,ovm}/summary.json`` (NGSIM)
and its results on OpenACC's run 040719_platoon7.
"""

from __future__ import annotations

from typing import Any

#: What was minimised: samples of segments, the gap, or the speed of whole pairs.
OBJECTIVES = ("segment", "spacing", "speed")

#: By law and objective: mean over the 20 test pairs of the root mean square error of the gap, m.
ERRORS = {
    "idm": (3.1773174421245995, 3.6929693301172186, 3.4872678552099523),
    "gipps": (3.1688457548304165, 3.7298151331760643, 3.993587160679182),
    "ovm": (3.382579318980459, 3.91879343078324, 4.617389627943549),
}

#: By law and parameter, for each objective; SI units.
PARAMETERS: dict[str, dict[str, tuple[float, float, float]]] = {
    "idm": {
        "v0": (35.0, 34.92372963262273, 17.11261459358489),
        "T": (1.2, 1.589721527185084, 1.5425360378070945),
        "a": (1.2981832722420068, 1.2061082325395718, 1.1818546310763451),
        "b": (1.5, 1.5, 1.5333064713084776),
        "s0": (2.3842278538874297, 2.262083849640175, 1.5),
    },
    "gipps": {
        "a": (1.2467981030374118, 1.3429598293591951, 1.4235317847947708),
        "v0": (15.54915126661188, 34.232852112410264, 15.0),
        "T": (1.2594157633504273, 1.288777568982078, 1.455933399514567),
        "b": (2.7575104477933396, 2.2423325796283513, 2.367160378256897),
        "b_1": (2.0, 2.0, 2.0),
        "s0": (1.5, 1.9032279326017694, 1.5),
    },
    "ovm": {
        "kappa": (1.998814088744838, 2.0, 2.0),
        "v0": (22.07383171055701, 17.649624753613477, 16.90972550640812),
        "s_c": (15.000033778133403, 15.0, 15.0),
        "w": (10.86769075986993, 15.458506216856604, 19.99189659034834),
    },
}

#: Their bounds.
BOUNDS: dict[str, dict[str, tuple[float, float]]] = {
    "idm": {"v0": (15, 35), "T": (1.2, 3), "a": (1, 2.5), "b": (1.5, 3), "s0": (1.5, 5)},
    "gipps": {
        "a": (1, 2.5),
        "v0": (15, 35),
        "T": (0.5, 2),
        "b": (1.5, 4),
        "b_1": (2, 4),
        "s0": (1.5, 4),
    },
    "ovm": {"kappa": (0.4, 2), "v0": (15, 35), "s_c": (15, 30), "w": (5, 20)},
}

#: Their search by SciPy's differential evolution.
EVOLUTION = {"popsize": 15, "maxiter": 60, "seed": 42}

#: m/s²: accelerations are clipped to this.
CLIPPED = {"idm": (-9.0, 6.0), "gipps": (-9.0, 6.0), "ovm": (-4.0, 2.5)}

#: OpenACC, the run, and the share of its samples that come first and are calibrated on.
PLATOON, FIRST = "040719_platoon7", 0.7

#: By make: root mean square error of the gap on the rest, m, of an optimal-velocity model.
PLATOON_ERRORS = {
    "BMW X5": 2.2122,
    "Tesla Model3": 3.2729,
    "Mercedes AClass": 3.4002,
    "Audi A6": 4.0596,
}

#: By make: its parameters; SI units.
PLATOON_PARAMETERS: dict[str, dict[str, float]] = {
    "BMW X5": {"kappa": 0.19394558, "v0": 35.09938675, "s_c": 19.07667874, "w": 14.21680789},
    "Tesla Model3": {"kappa": 0.34005405, "v0": 46.16538876, "s_c": 24.19703895, "w": 20.07872137},
    "Mercedes AClass": {
        "kappa": 0.28962431,
        "v0": 37.48658431,
        "s_c": 14.57924904,
        "w": 27.35283726,
    },
    "Audi A6": {"kappa": 0.23499602, "v0": 35.08985883, "s_c": 14.45415175, "w": 25.67332852},
}

_UNITS = {
    "v0": "m/s",
    "T": "s",
    "s0": "m",
    "a": "m/s²",
    "b": "m/s²",
    "b_1": "m/s²",
    "kappa": "1/s",
    "s_c": "m",
    "w": "m",
}


def clipped(
    law: dict[str, Any], limits: tuple[float, float], values: dict[str, float]
) -> dict[str, Any]:
    """A law of the shelf with published parameters, its acceleration clipped, in the published
    steps, ballistic ones.

    Args:
        law: its description, see :data:`nnode.model.laws.CAR_FOLLOWING_LAWS`.
        limits: m/s².
        values: by parameter, SI units.
    """
    low, high = limits
    ends = {"least_rate": f"{low} m/s²", "most_rate": f"{high} m/s²"}
    return {
        **law,
        "parameters": {name: f"{value!r} {_UNITS[name]}" for name, value in values.items()},
        "constants": {**law.get("constants", {}), **ends},
        "rate": {"v": f"clip({law['rate']['v']}, least_rate, most_rate)"},
        "step": "ballistic",
    }
