"""User-defined effects: Python files named in an environment variable."""

from __future__ import annotations

import importlib.util
import os
import sys
from pathlib import Path

from nnode.errors import ConfigError

#: Environment variable with the files that define effects, separated as in PATH.
VARIABLE = "NNODE_EFFECTS"

_loaded: set[Path] = set()


def load_own() -> None:
    """Run the files that :data:`VARIABLE` names, each once per process.

    The files add their effects to the catalogue. No checkpoint and no option can make the package
    run a file.

    Raises:
        ConfigError: a file does not exist or fails.
    """
    for name in filter(None, os.environ.get(VARIABLE, "").split(os.pathsep)):
        path = Path(name).expanduser().resolve()
        if path in _loaded:
            continue
        if not path.is_file():
            raise ConfigError(
                f"{VARIABLE} names {name}, there is no such file; it must name Python files that "
                "define effects"
            )
        module_name = f"nnode_own_{path.stem}"
        spec = importlib.util.spec_from_file_location(module_name, path)
        if spec is None or spec.loader is None:
            raise ConfigError(f"{VARIABLE} names {name}, expected a Python file (.py)")
        module = importlib.util.module_from_spec(spec)
        sys.modules[module_name] = module
        try:
            spec.loader.exec_module(module)
        except Exception as error:  # user code may raise anything
            del sys.modules[module_name]
            raise ConfigError(
                f"{path}, named in {VARIABLE}, fails: {type(error).__name__}: {error}"
            ) from error
        _loaded.add(path)
