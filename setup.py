"""What ``pyproject.toml`` cannot say.

``conf/`` stands at the top of a checkout, and is installed as ``nnode/conf``. An index shows the
readme without the files beside it: pictures and links lead into the repository where
``[project.urls]`` names it as ``Repository``; without it links are words and pictures left out.
"""

import re
import tomllib
from pathlib import Path

from setuptools import find_packages, setup

ROOT = Path(__file__).parent
PICTURE = re.compile(r"!\[([^\]]*)\]\((?!https?:)([^)]+)\)\n\n(\*[^*]+\*\n\n)?")
LINK = re.compile(r"(?<!!)\[([^\]]+)\]\((?!https?:|#)([^)]+)\)")


def described(text: str, repository: str | None) -> str:
    """The readme as an index can show it."""
    if repository is None:
        return LINK.sub(r"\1", PICTURE.sub("", text))
    text = PICTURE.sub(rf"![\1]({repository}/raw/HEAD/\2)\n\n\3", text)
    return LINK.sub(rf"[\1]({repository}/blob/HEAD/\2)", text)


if __name__ == "__main__":
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    setup(
        packages=[*find_packages(include=["nnode*", "studies*"]), "nnode.conf"],
        package_dir={"nnode.conf": "conf"},
        long_description=described(readme, project["urls"].get("Repository")),
        long_description_content_type="text/markdown",
    )
