"""The wheel works alone: built, installed into an empty environment, used far from the checkout."""

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
def alone(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Run:
    return installed(wheel, tmp_path_factory.mktemp("environment"))


@pytest.mark.thorough
def test_the_package_comes_from_the_wheel(alone: Run) -> None:
    done = alone("python", "-c", "import nnode, os; print(os.getcwd(), nnode.__file__)")
    folder, file = map(Path, done.stdout.split())
    assert ROOT not in (*folder.parents, *file.parents)
    assert "site-packages" in file.parts


@pytest.mark.thorough
def test_the_program_lists_its_commands(alone: Run) -> None:
    done = alone("nnode", "--help")
    assert done.returncode == 0, done.stderr
    commands = {path.stem for path in (ROOT / "nnode" / "app" / "commands").glob("[a-z]*.py")}
    assert set(re.findall(r"^  (\w+)  ", done.stdout, re.M)) == commands
    assert "scripts" not in done.stdout
    wrong = alone("nnode", "trian")
    assert wrong.returncode == 2
    assert "did you mean train?" in wrong.stderr


@pytest.mark.thorough
@pytest.mark.parametrize(
    "name", ["train", "discover", "study", "evaluate", "export", "plot_forces", "prepare_data"]
)
def test_a_command_takes_what_its_script_takes(alone: Run, name: str) -> None:
    installed = alone("nnode", name, "--help")
    assert installed.returncode == 0, installed.stderr
    script = subprocess.run(
        [sys.executable, f"scripts/{name}.py", "--help"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        env={**os.environ, "NNODE_DATA": ""},
        check=False,
    )
    assert installed.stdout == script.stdout


@pytest.mark.thorough
def test_a_table_of_one_s_own_is_calibrated_evaluated_and_gone_on_with(alone: Run) -> None:
    work = Path(alone("python", "-c", "import os; print(os.getcwd())").stdout.strip())
    as_table(platoons(number=4, seconds=6.0)).to_csv(work / "mine.csv", index=False)
    done = alone(
        "nnode",
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
    assert done.returncode == 0, done.stderr
    result = json.loads((work / "run" / "result.json").read_text())
    assert result["summary"]["cost_train"] < result["summary"]["cost_start"]
    done = alone("nnode", "evaluate", "checkpoint=run/checkpoints/best.pt", "hydra.run.dir=e")
    assert done.returncode == 0, done.stderr
    metrics = json.loads((work / "e" / "metrics.json").read_text())
    assert metrics["J"] == pytest.approx(result["summary"]["cost_heldout"], rel=1e-9)
    done = alone(
        "nnode",
        "train",
        "resume=run/checkpoints/last.pt",
        "trainer.max_epochs=5",
        "hydra.run.dir=run",
    )
    assert done.returncode == 0, done.stderr
    assert json.loads((work / "run" / "result.json").read_text())["history"][-1]["epoch"] == 5


#: In an environment without what is optional.
ESTIMATOR = """
import sys
sys.modules.update(dict.fromkeys(("sklearn", "xarray")))
import nnode
import pandas as pd
table = pd.read_csv("pairs.csv")
one = nnode.Calibrator(model="idm", method="ballistic").fit(table)  # as the table was made
print(one.parameters_.estimate["idm.T"], one.predict(table).score(table))
try:
    one.result_.to_xarray()
except nnode.errors.ConfigError as error:
    print(error)
assert "sklearn" not in {name for name, module in sys.modules.items() if module}
"""


@pytest.mark.thorough
def test_the_estimator_works_without_scikit_learn(alone: Run) -> None:
    work = Path(alone("python", "-c", "import os; print(os.getcwd())").stdout.strip())
    pairs(number=4, seconds=20.0).to_csv(work / "pairs.csv", index=False)
    done = alone("python", "-c", ESTIMATOR)
    assert done.returncode == 0, done.stderr
    found, said = done.stdout.splitlines()
    T, score = map(float, found.split())
    assert pytest.approx(TRUE["T"], rel=1e-3) == T
    assert -1e-3 < score <= 0
    assert "pip install 'nnode[xarray]'" in said


@pytest.mark.thorough
def test_an_index_can_show_what_the_wheel_says_of_itself(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        (name,) = (n for n in archive.namelist() if n.endswith(".dist-info/METADATA"))
        told = message_from_string(archive.read(name).decode())
        names = archive.namelist()
    assert told["Description-Content-Type"] == "text/markdown"
    assert told["License-Expression"] == "MIT"
    assert told.get_all("Project-URL")
    page = str(told.get_payload())
    assert "# nnode" in page
    targets = re.findall(r"\]\(([^)]+)\)", page)
    assert [target for target in targets if not target.startswith(("https://", "#"))] == []
    assert not [n for n in names if n.startswith(("benchmarks", "scripts", "tests", "setup"))]
    assert not [n for n in names if "benchmark" in n or "fault_injection" in n]
    shipped = {n for n in names if n.startswith("nnode/conf/")}
    ours = {f"nnode/conf/{p.relative_to(ROOT / 'conf')}" for p in (ROOT / "conf").rglob("*.yaml")}
    assert {n for n in ours if "benchmark" not in n and "fault_injection" not in n} == shipped
    model = {str(p.relative_to(ROOT)) for p in (ROOT / "nnode/model").rglob("*.yaml")}
    assert model
    assert model <= set(names)


def test_pictures_and_links_lead_into_a_repository_where_it_is_known() -> None:
    described = runpy.run_path(str(ROOT / "setup.py"), run_name="setup")["described"]
    text = (
        "a [page](docs/a.md#b), [paper](https://x)\n\n![alt](docs/p.png)\n\n*What it shows.*\n\nb"
    )
    assert described(text, None) == "a page, [paper](https://x)\n\nb"
    assert described(text, "https://host/us/it") == (
        "a [page](https://host/us/it/blob/HEAD/docs/a.md#b), [paper](https://x)\n\n"
        "![alt](https://host/us/it/raw/HEAD/docs/p.png)\n\n*What it shows.*\n\nb"
    )
