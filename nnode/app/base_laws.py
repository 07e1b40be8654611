"""Base laws beside the one that was asked for: which there are, and which of them is nearest."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from typing import Any

from nnode.app.python.inputs import MODELS, model_options
from nnode.discover.options import DiscoverOptions
from nnode.errors import ConfigError
from nnode.models import System, build_model
from nnode.models.system import Traffic

#: Laws that are compared where none are named; networks contain effects, and newell remembers step
#: by step.
LAWS = {
    "traffic": ("lin", "log", "idm", "ovm", "fvdm", "gipps", "krauss", "helly"),
    "crowd": ("sf", "esf", "gcfm", "ttc"),
}

#: Options that say what is simulated, not by which law.
SHARED = ("desired", "neighbours")


def candidates(
    model: Mapping[str, Any], asked: System, options: DiscoverOptions
) -> dict[str, System]:
    """Models by name, the one that was asked for among them; vehicles drive behind measured
    leaders, people want to go where the one that was asked for says. None where nothing is to be
    compared.

    Args:
        model: options of the one that was asked for.

    Raises:
        ConfigError: an unknown name, or one of another domain.
    """
    names = LAWS[asked.domain] if options.compare is None else options.compare
    found: dict[str, System] = {}
    for one in names:
        if one not in MODELS:
            raise ConfigError(
                f"discover.compare: there is no model {one}, expected some of "
                f"{', '.join(LAWS[asked.domain])}, or another name as in conf/model"
            )
        found[one] = build_model(law_options(one, model), options.seed)
        if found[one].domain != asked.domain:
            raise ConfigError(
                f"discover.compare: {one} is a {found[one].domain} model, the data and the model "
                f"are of {asked.domain}; leave it out"
            )
    if found:
        own = found[str(model["name"])] = copy.deepcopy(asked)
        if isinstance(own, Traffic):
            own.leader = "measured"
    return found


def law_options(name: str, asked: Mapping[str, Any]) -> dict[str, Any]:
    """Options of a model that is compared with another one."""
    found = model_options(name, "measured")
    return {**found, **{key: asked[key] for key in SHARED if key in asked and key in found}}
