"""Where the runs of a sweep, and the processes of one run, are started."""

from __future__ import annotations

import logging
import os
import sys
import tempfile
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec

from nnode.calibrate.distributed import World, started_together
from nnode.errors import ConfigError

#: Launchers that come with a plugin, and the plugin.
PLUGINS = {
    "cores": "hydra_plugins.hydra_joblib_launcher",
    "joblib": "hydra_plugins.hydra_joblib_launcher",
    "slurm": "hydra_plugins.hydra_submitit_launcher",
    "submitit_slurm": "hydra_plugins.hydra_submitit_launcher",
    "submitit_local": "hydra_plugins.hydra_submitit_launcher",
}


def check_launcher(overrides: list[str]) -> None:
    """Refuse a launcher that is not installed, or that cannot be combined with ``torchrun``.

    Raises:
        ConfigError: says what to install or to leave out.
    """
    for override in overrides:
        key, _, launcher = override.partition("=")
        if key.lstrip("+") != "hydra/launcher" or launcher == "basic":
            continue
        if World().size > 1:
            raise ConfigError(
                f"hydra/launcher={launcher} starts processes of its own, and so does torchrun; "
                "use one of them"
            )
        if launcher in PLUGINS and not _installed(PLUGINS[launcher]):
            raise ConfigError(
                f"hydra/launcher={launcher} needs a plugin of Hydra that is not installed; "
                "install it with: pip install 'nnode[cluster]'"
            )


def _installed(module: str) -> bool:
    try:
        return find_spec(module) is not None
    except ModuleNotFoundError:
        return False


def has_no_part(parallel: bool) -> bool:
    """Whether this is one of several processes, and the work is for the first one alone."""
    return started_together() and not parallel and os.environ["RANK"] != "0"


@contextmanager
def out_of_sight(overrides: list[str]) -> Iterator[None]:
    """Silence for all processes but the first, whose folders Hydra shall not find.

    Args:
        overrides: those of the command line, in ``sys.argv``.
    """
    if World().first:
        yield
        return
    with tempfile.TemporaryDirectory(prefix="nnode-") as folder:
        own = ("hydra.run.dir", "hydra.sweep.dir", "hydra.output_subdir")
        # in the place of the last override: Hydra wants them side by side
        place = sys.argv.index(overrides[-1]) if overrides else len(sys.argv) - 1
        rest = [f"{own[0]}={folder}", f"{own[1]}={folder}", f"{own[2]}=null"]
        sys.argv[place + 1 : place + 1] = rest
        logging.disable(logging.CRITICAL)
        warnings.simplefilter("ignore")
        yield
