"""The laws that a diagnosis compares."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from typing import Any

from nnode.app.python.inputs import model_options
from nnode.config import choices
from nnode.diagnosis.options import DiscoverOptions
from nnode.errors import ConfigError
from nnode.model import System, build_model
from nnode.model.system import Traffic

#: Default laws of the comparison. Networks are excluded because they contain effects, and newell
#: because it remembers steps.
LAWS = {
    "traffic": ("lin", "log", "idm", "ovm", "fvdm", "gipps", "krauss", "helly"),
    "crowd": ("sf", "esf", "gcfm", "ttc"),
}

#: Options of the simulation that all compared laws share.
SHARED = ("desired", "neighbours")


def compared_laws(
    model: Mapping[str, Any], requested: System, options: DiscoverOptions
) -> dict[str, System]:
    """Name to model for the comparison, including the requested model; empty without a comparison.

    Vehicles follow measured leaders. People have the destinations of the requested model.

    Args:
        model: options of the requested model.
        requested: the requested model.

    Raises:
        ConfigError: a name is unknown, or its model has another domain.
    """
    names = LAWS[requested.domain] if options.compare is None else options.compare
    models: dict[str, System] = {}
    for name in names:
        if name not in choices("model"):
            raise ConfigError(
                f"discover.compare: there is no model {name}, expected some of "
                f"{', '.join(LAWS[requested.domain])}, or another name as in conf/model"
            )
        models[name] = build_model(law_options(name, model), options.seed)
        if models[name].domain != requested.domain:
            raise ConfigError(
                f"discover.compare: {name} is a {models[name].domain} model, the data and the "
                f"model are of {requested.domain}; leave it out"
            )
    if models:
        requested = models[str(model["name"])] = copy.deepcopy(requested)
        if isinstance(requested, Traffic):
            requested.leader = "measured"
    return models


def law_options(name: str, requested: Mapping[str, Any]) -> dict[str, Any]:
    """Options of a model for the comparison with the model of the options ``requested``."""
    options = model_options(name, "measured")
    shared = {key: requested[key] for key in SHARED if key in requested and key in options}
    return {**options, **shared}
