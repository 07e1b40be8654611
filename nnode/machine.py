"""The machine and the versions with which a result was computed."""

from __future__ import annotations

import os
import platform
from collections.abc import Iterable
from datetime import datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from nnode.program import command_line
from nnode.version import VERSION


def cores() -> int:
    """Number of cores that this process may use."""
    allowed = getattr(os, "sched_getaffinity", None)
    return len(allowed(0)) if allowed else os.cpu_count() or 1


def machine(packages: Iterable[str]) -> dict[str, Any]:
    """The processor, its cores, the system, the load, and the versions of Python and packages."""
    versions = {"python": platform.python_version()}
    for package in packages:
        try:
            versions[package] = version(package)
        except PackageNotFoundError:
            versions[package] = "absent"
    processor = platform.processor() or platform.machine()
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.is_file():
        names = [line for line in cpuinfo.read_text().splitlines() if "model name" in line]
        processor = names[0].split(":", 1)[1].strip() if names else processor
    return {
        "processor": processor,
        "cores": os.cpu_count(),
        "system": platform.platform(),
        "load": os.getloadavg()[0] if hasattr(os, "getloadavg") else None,
        "versions": versions,
    }


def how_made(packages: Iterable[str]) -> dict[str, str]:
    """Facts on how a page was made: command, date, machine, versions."""
    here = machine(packages)
    versions = {"nnode": VERSION, **here["versions"]}
    return {
        "Command": command_line(),
        "Date": datetime.now().astimezone().strftime("%Y-%m-%d %H:%M %Z"),
        "Machine": f"{here['processor']}, {here['cores']} cores, {here['system']}",
        "Versions": ", ".join(f"{name} {number}" for name, number in versions.items()),
    }
