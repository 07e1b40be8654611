"""The wheel in an empty environment, outside of the checkout."""

from __future__ import annotations

import json
import os
import re
import runpy
import subprocess
import sys
import zipfile
from email import message_from_string
from pathlib import Path

import pytest

from tests.app.following import TRUE, pairs
from tests.builders import as_table
from tests.diagnosis.platoons import platoons
from tests.installed import Run, built, installed

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return built(tmp_path_factory.mktemp("wheel"))


@pytest.fixture(scope="module")
def run(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Run:
    """Run a command of the environment."""
    return installed(wheel, tmp_path_factory.mktemp("environment"))


@pytest.mark.thorough
def test_package_is_imported_from_the_wheel(run: Run) -> None:
    done = run("python", "-c", "import nnode, os; print(os.getcwd(), nnode.__file__)")
    folder, file = map(Path, done.stdout.split())
    assert ROOT not in (*folder.parents, *file.parents)
    assert "site-packages" in file.parts


@pytest.mark.thorough
def test_help_lists_commands(run: Run) -> None:
    done = run("nnode", "--help")
    assert done.returncode == 0, done.stderr
    commands = {path.stem for path in (ROOT / "nnode" / "app" / "commands").glob("[a-z]*.py")}
    assert set(re.findall(r"^  (\w+)  ", done.stdout, re.M)) == commands
    assert "scripts" not in done.stdout
    wrong = run("nnode", "trian")
    assert wrong.returncode == 2
    assert "did you mean train?" in wrong.stderr


@pytest.mark.thorough
@pytest.mark.parametrize(
    "name", ["train", "discover", "study", "evaluate", "export", "plot_forces", "prepare_data"]
)
def test_help_of_a_command_as_of_its_script(run: Run, name: str) -> None:
    command = run("nnode", name, "--help")
    assert command.returncode == 0, command.stderr
    script = subprocess.run(
        [sys.executable, f"scripts/{name}.py", "--help"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        env={**os.environ, "NNODE_DATA": ""},
        check=False,
    )
    assert command.stdout == script.stdout


@pytest.fixture
def work(run: Run) -> Path:
    """The working folder of the environment's commands."""
    return Path(run("python", "-c", "import os; print(os.getcwd())").stdout.strip())


@pytest.mark.thorough
def test_train_evaluate_and_resume(run: Run, work: Path) -> None:
    def nnode(*arguments: str) -> None:
        done = run("nnode", *arguments)
        assert done.returncode == 0, done.stderr

    as_table(platoons(number=4, seconds=6.0)).to_csv(work / "mine.csv", index=False)
    nnode(
        "train",
        "model=lin",
        "model.leader=measured",
        "solver=fused",
        "optimizer=lbfgs",
        "data=table",
        "data.path=mine.csv",
        "data.domain=traffic",
        "trainer.max_epochs=3",
        "hydra.run.dir=run",
    )
    result = json.loads((work / "run" / "result.json").read_text())
    assert result["summary"]["cost_train"] < result["summary"]["cost_start"]
    nnode("evaluate", "checkpoint=run/checkpoints/best.pt", "hydra.run.dir=e")
    metrics = json.loads((work / "e" / "metrics.json").read_text())
    assert metrics["J"] == pytest.approx(result["summary"]["cost_heldout"], rel=1e-9)
    nnode("train", "resume=run/checkpoints/last.pt", "trainer.max_epochs=5", "hydra.run.dir=run")
    assert json.loads((work / "run" / "result.json").read_text())["history"][-1]["epoch"] == 5


#: In an environment without optional packages.
ESTIMATOR = """
import sys
sys.modules.update(dict.fromkeys(("sklearn", "xarray")))
import nnode
import pandas as pd
table = pd.read_csv("pairs.csv")
fitted = nnode.Calibrator(model="idm", method="ballistic").fit(table)
print(fitted.parameters_.estimate["idm.T"], fitted.predict(table).score(table))
try:
    fitted.result_.to_xarray()
except nnode.errors.ConfigError as error:
    print(error)
assert "sklearn" not in {name for name, module in sys.modules.items() if module}
"""


@pytest.mark.thorough
def test_estimator_works_without_scikit_learn(run: Run, work: Path) -> None:
    pairs(number=4, seconds=20.0).to_csv(work / "pairs.csv", index=False)
    done = run("python", "-c", ESTIMATOR)
    assert done.returncode == 0, done.stderr
    numbers, message = done.stdout.splitlines()
    T, score = map(float, numbers.split())
    assert pytest.approx(TRUE["T"], rel=1e-3) == T
    assert -1e-3 < score <= 0
    assert "pip install 'nnode[xarray]'" in message


@pytest.mark.thorough
def test_metadata_and_files_of_the_wheel(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        names = archive.namelist()
        (name,) = (n for n in names if n.endswith(".dist-info/METADATA"))
        metadata = message_from_string(archive.read(name).decode())
    assert metadata["Description-Content-Type"] == "text/markdown"
    assert metadata["License-Expression"] == "MIT"
    assert metadata.get_all("Project-URL")
    page = str(metadata.get_payload())
    assert "# nnode" in page
    targets = re.findall(r"\]\(([^)]+)\)", page)
    assert [target for target in targets if not target.startswith(("https://", "#"))] == []
    assert not [n for n in names if n.startswith(("benchmarks", "scripts", "tests", "setup"))]
    assert not [n for n in names if "benchmark" in n or "fault_injection" in n]
    packaged = {n for n in names if n.startswith("nnode/conf/")}
    conf = {f"nnode/conf/{p.relative_to(ROOT / 'conf')}" for p in (ROOT / "conf").rglob("*.yaml")}
    assert {n for n in conf if "benchmark" not in n and "fault_injection" not in n} == packaged
    model = {str(p.relative_to(ROOT)) for p in (ROOT / "nnode/model").rglob("*.yaml")}
    assert model
    assert model <= set(names)


def test_links_of_the_description_point_to_the_repository() -> None:
    described = runpy.run_path(str(ROOT / "setup.py"), run_name="setup")["described"]
    text = (
        "a [page](docs/a.md#b), [paper](https://x)\n\n![alt](docs/p.png)\n\n*What it shows.*\n\nb"
    )
    assert described(text, None) == "a page, [paper](https://x)\n\nb"
    assert described(text, "https://host/us/it") == (
        "a [page](https://host/us/it/blob/HEAD/docs/a.md#b), [paper](https://x)\n\n"
        "![alt](https://host/us/it/raw/HEAD/docs/p.png)\n\n*What it shows.*\n\nb"
    )
