"""Flags of a command line: what may stand there beside options, and what each one wants."""

from __future__ import annotations

from dataclasses import dataclass, field
from difflib import get_close_matches
from pathlib import Path

from nnode.errors import ConfigError

#: Flags without a value; short forms first lead to the long one.
PLAIN = {
    "-h": "--help",
    "-m": "--multirun",
    "-r": "--run",
    "-sc": "--shell-completion",
    "--help": "--help",
    "--multirun": "--multirun",
    "--run": "--run",
    "--resolve": "--resolve",
    "--version": "--version",
    "--hydra-help": "--hydra-help",
    "--shell-completion": "--shell-completion",
}

#: Flags with a value, as the next argument or behind an equals sign.
VALUED = {
    "-c": "--cfg",
    "-p": "--package",
    "-i": "--info",
    "-cd": "--config-dir",
    "-cp": "--config-path",
    "-cn": "--config-name",
    "--cfg": "--cfg",
    "--package": "--package",
    "--info": "--info",
    "--config-dir": "--config-dir",
    "--config-path": "--config-path",
    "--config-name": "--config-name",
    "--experimental-rerun": "--experimental-rerun",
}

#: What can be shown in place of working.
SHOWN = ("job", "hydra", "all")


@dataclass
class CommandLine:
    """What stands on a command line.

    Attributes:
        overrides: options and choices, ``name=value``.
        flags: long names of the flags, with their values.
    """

    overrides: list[str] = field(default_factory=list)
    flags: dict[str, str] = field(default_factory=dict)

    @property
    def sweeps(self) -> bool:
        """Whether several runs are asked for."""
        return "--multirun" in self.flags

    @property
    def folder(self) -> Path | None:
        """Further groups of the user's own."""
        return Path(self.flags["--config-dir"]) if "--config-dir" in self.flags else None


def read_command_line(arguments: list[str]) -> CommandLine:
    """Tell flags from overrides.

    Raises:
        ConfigError: an unknown flag, or one without its value; says what is meant, or what to do.
    """
    line, rest = CommandLine(), list(arguments)
    while rest:
        argument = rest.pop(0)
        if not argument.startswith("-"):
            line.overrides.append(argument)
        elif argument in PLAIN:
            line.flags[PLAIN[argument]] = ""
        else:
            name, equals, value = argument.partition("=")
            if name not in VALUED:
                raise ConfigError(_unknown(name, value))
            if not equals:
                if not rest or "=" in rest[0]:
                    raise ConfigError(f"{name} needs a value behind it{_expected(VALUED[name])}")
                value = rest.pop(0)
            line.flags[VALUED[name]] = value
    _check(line)
    return line


def _unknown(name: str, value: str) -> str:
    near = get_close_matches(name, [*PLAIN, *VALUED], n=1, cutoff=0.7)
    if near:
        return f"{name} is no flag; did you mean {near[0]}?"
    option = f"{name.lstrip('-').replace('-', '_')}={value or 'VALUE'}"
    return (
        f"{name} is no flag: options are written without dashes, as {option}; "
        "--help lists options and flags"
    )


def _expected(flag: str) -> str:
    return {
        "--cfg": f": {', '.join(SHOWN)}",
        "--config-dir": ": a folder with configuration groups of your own",
        "--package": ": a part of the configuration, such as trainer",
    }.get(flag, "")


def _check(line: CommandLine) -> None:
    shown, folder = line.flags.get("--cfg"), line.folder
    if shown is not None and shown not in SHOWN:
        raise ConfigError(f"--cfg {shown} is unknown, expected one of {', '.join(SHOWN)}")
    for flag in ("--resolve", "--package"):
        if flag in line.flags and shown is None:
            raise ConfigError(f"{flag} only goes with --cfg; add --cfg job")
    for flag in ("--config-name", "--config-path"):
        if flag in line.flags:
            raise ConfigError(
                f"{flag} is not taken: every script has its own configuration; groups of your "
                "own are found with --config-dir FOLDER"
            )
    if folder is not None and not folder.is_dir():
        raise ConfigError(f"--config-dir: there is no folder {folder}; expected one with groups")
