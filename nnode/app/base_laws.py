"""Base laws beside the one that was asked for: which there are, and which of them is nearest."""

from __future__ import annotations

import copy
from typing import Any

from nnode.app.python.inputs import MODELS, model_options
from nnode.data.sequence import Sequence
from nnode.discover.compare.laws import compare_laws
from nnode.discover.options import DiscoverOptions
from nnode.discover.result import Laws
from nnode.errors import ConfigError
from nnode.models import System, build_model
from nnode.models.system import Traffic

#: Laws that are compared where none are named; networks contain effects, and newell remembers step
#: by step.
LAWS = {
    "traffic": ("lin", "log", "idm", "ovm", "fvdm", "gipps", "krauss", "helly"),
    "crowd": ("sf", "esf", "gcfm", "ttc"),
}


def candidates(name: str, asked: System, options: DiscoverOptions) -> dict[str, System]:
    """Models by name, the one that was asked for among them; vehicles drive behind measured
    leaders. None where nothing is to be compared.

    Args:
        name: of the model that was asked for.

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
        found[one] = build_model(law_options(one), options.seed)
        if found[one].domain != asked.domain:
            raise ConfigError(
                f"discover.compare: {one} is a {found[one].domain} model, the data and the model "
                f"are of {asked.domain}; leave it out"
            )
    if found:
        own = found[name] = copy.deepcopy(asked)
        if isinstance(own, Traffic):
            own.leader = "measured"
    return found


def law_options(name: str) -> dict[str, Any]:
    """Options of a model that is compared."""
    return model_options(name, "measured")


def compared(
    name: str, asked: System, sequences: list[Sequence], options: DiscoverOptions
) -> Laws | None:
    """The ranking; None where nothing is to be compared."""
    found = candidates(name, asked, options)
    return compare_laws(found, sequences, options) if found else None
