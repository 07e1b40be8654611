"""The program ``nnode`` with a command for each file in ``nnode/app/commands``."""

from __future__ import annotations

import sys
import textwrap
from importlib import import_module

from nnode.errors import suggestion
from nnode.program import COMMANDS, words
from nnode.version import VERSION

#: Other words for commands: names of functions in Python, and a common synonym.
SYNONYMS = {"calibrate": "train", "diagnose": "discover", "fit": "train"}


def main() -> None:
    """Run the command that the command line names; end the process if there is no such command."""
    given = sys.argv[1:]
    names = sorted(path.stem for path in COMMANDS.glob("[a-z]*.py"))
    name = given[0] if given else "--help"
    if name in ("-h", "--help"):
        print(_help(names))
    elif name == "--version":
        print(f"nnode {VERSION}")
    elif name in names:
        del sys.argv[1]
        import_module(f"nnode.app.commands.{name}").main()
    else:
        print(
            f"error: there is no command {name}, expected one of {', '.join(names)}"
            f"{suggestion(name, dict(zip(names, names, strict=True)) | SYNONYMS)}",
            file=sys.stderr,
        )
        sys.exit(2)


def _help(names: list[str]) -> str:
    rows = []
    for name in names:
        about = textwrap.wrap(words(name).splitlines()[0], 82)
        rows += [f"  {name:<14}{about[0]}", *(f"{'':<16}{line}" for line in about[1:])]
    return "\n".join(
        [
            "Calibrate interacting particle systems to measured trajectories, and diagnose them.",
            "",
            "nnode COMMAND [NAME=VALUE ...]",
            *rows,
            "",
            "nnode COMMAND --help shows examples, choices and all options of a command.",
            "nnode --version shows the version.",
        ]
    )


if __name__ == "__main__":
    main()
