"""The example driver as an installed package of another author passes the contract tests."""

from __future__ import annotations

import importlib.util
import os
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

pytestmark = pytest.mark.real_time

ROOT = Path(__file__).resolve().parents[2]
EXAMPLE = ROOT / "examples" / "jointfit-example-driver"


@pytest.fixture
def installed(tmp_path: Path) -> dict[str, str]:
    """Write the metadata that an installer creates; return an environment that contains them.

    This works offline and without the build backend. Another test installs the package.
    """
    project = tomllib.loads((EXAMPLE / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    info = tmp_path / f"{project['name'].replace('-', '_')}-{project['version']}.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(
        f"Metadata-Version: 2.1\nName: {project['name']}\nVersion: {project['version']}\n",
        encoding="utf-8",
    )
    lines = [
        line
        for group, points in project["entry-points"].items()
        for line in (f"[{group}]", *(f"{name} = {value}" for name, value in points.items()))
    ]
    (info / "entry_points.txt").write_text("\n".join(lines), encoding="utf-8")
    return seeing(tmp_path, EXAMPLE / "src")


def seeing(*folders: Path) -> dict[str, str]:
    ours = [ROOT, ROOT / "drivers", ROOT / "protocols", ROOT / "simulators"]
    return os.environ | {"PYTHONPATH": os.pathsep.join(map(str, [*folders, *ours]))}


def python(environment: dict[str, str], *arguments: str) -> str:
    done = subprocess.run(
        [sys.executable, *arguments], env=environment, cwd=EXAMPLE, capture_output=True,
        text=True, timeout=90, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


FIND = "from jointfit_daemon.driver import find_driver; print(find_driver('board').__qualname__)"


def test_the_installed_driver_is_found_by_name(installed: dict[str, str]) -> None:
    assert python(installed, "-c", FIND).strip() == "BoardImu"


@pytest.mark.timeout(100)
def test_the_example_passes_the_contract_and_its_own_tests(installed: dict[str, str]) -> None:
    said = python(installed, "-m", "pytest", "-q", "-p", "no:cacheprovider")
    assert "skipped" not in said.splitlines()[-1]


@pytest.mark.timeout(100)
@pytest.mark.skipif(
    importlib.util.find_spec("hatchling") is None,
    reason="hatchling is not installed: the project cannot be built offline",
)
def test_pip_installs_it(tmp_path: Path) -> None:
    python(
        dict(os.environ), "-m", "pip", "install", "--quiet", "--no-deps", "--no-build-isolation",
        "--no-index", "--target", str(tmp_path), str(EXAMPLE),
    )  # fmt: skip
    assert python(seeing(tmp_path), "-c", FIND).strip() == "BoardImu"


def test_the_guide_names_the_files_that_are_there() -> None:
    guide = (ROOT / "docs" / "write-a-driver.md").read_text(encoding="utf-8")
    for file in EXAMPLE.rglob("*.py"):
        if file.name != "__init__.py":
            assert file.name in guide, file
