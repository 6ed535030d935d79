"""Packages: reproducible, complete, without secret keys; maintainer scripts and manual pages."""

from __future__ import annotations

import importlib
import os
import re
import shlex
import shutil
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

import pytest
from typer.main import get_command

from jointfit_daemon.__main__ import _parser
from jointfit_daemon.tools.__main__ import app

ROOT = Path(__file__).resolve().parents[2]
DEBIAN = ROOT / "packaging" / "debian"
MANUALS = ROOT / "packaging" / "man"
COMMANDS = sorted(get_command(app).commands)  # type: ignore[attr-defined]  # it is a group


def tracked() -> list[Path]:
    git = shutil.which("git")
    if git is None or not (ROOT / ".git").exists():
        pytest.skip("not a git checkout: there is no list of the project's files")
    listed = subprocess.run(
        [git, "-C", str(ROOT), "ls-files", "-z"], capture_output=True, check=True
    ).stdout
    paths = [ROOT / name.decode() for name in listed.split(b"\0") if name]
    return [path for path in paths if path.is_file()]


def built(checkout: Path, folder: Path, zone: str = "UTC") -> dict[str, Path]:
    """Return the wheel and the sdist that hatchling builds from `checkout`, by suffix."""
    subprocess.run(
        [sys.executable, "-m", "hatchling", "build", "--directory", str(folder)],
        cwd=checkout, check=True, capture_output=True, env=os.environ | {"TZ": zone},
    )  # fmt: skip
    return {path.suffix: path for path in folder.iterdir()}


@pytest.fixture(scope="module")
def archives(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    return built(ROOT, tmp_path_factory.mktemp("archives"))


def test_two_builds_in_other_places_and_zones_are_the_same_bytes(tmp_path: Path) -> None:
    first, second = tmp_path / "first", tmp_path / "second"
    for path in tracked():
        target = first / path.relative_to(ROOT)
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(path, target)
    shutil.copytree(first, second)
    one, other = built(first, tmp_path / "1"), built(second, tmp_path / "2", "EST5EDT")
    assert set(one) == set(other) == {".whl", ".gz"}
    for suffix, path in one.items():
        assert path.read_bytes() == other[suffix].read_bytes()


def test_the_wheel_has_programs_units_rules_and_manual_pages(archives: dict[str, Path]) -> None:
    with zipfile.ZipFile(archives[".whl"]) as wheel:
        names = wheel.namelist()
    for wanted in (
        "lib/systemd/system/jointfitd.service", "lib/systemd/system/jointfitd@.service",
        "lib/udev/rules.d/70-jointfitd.rules", "share/man/man1/jointfitd.1",
        "licenses/LICENSE", "jointfit_daemon/py.typed", "entry_points.txt",
    ):  # fmt: skip
        assert any(name.endswith(wanted) for name in names), wanted
    assert not [name for name in names if name.startswith(("tests/", "bench/"))]


def test_sdist_contains_build_files_tests_and_pinned_versions(archives: dict[str, Path]) -> None:
    with tarfile.open(archives[".gz"]) as sdist:
        names = {name.partition("/")[2] for name in sdist.getnames()}
    for wanted in ("pyproject.toml", "requirements.lock", "LICENSE", "CHANGELOG.md", "Makefile"):
        assert wanted in names
    assert any(name.startswith("tests/") for name in names)
    assert not [name for name in names if ".venv" in name or name.startswith("build/")]


@pytest.mark.parametrize("name", ["postinst", "prerm", "postrm"])
def test_maintainer_scripts_are_sound_shell_and_guard_systemd(name: str) -> None:
    script = DEBIAN / name
    subprocess.run(["sh", "-n", str(script)], check=True)
    text = script.read_text()
    assert text.startswith("#!/bin/sh\n")
    assert "set -e" in text
    assert "-d /run/systemd/system" in text  # in a chroot, systemd does not run
    assert "systemctl" not in text.partition("-d /run/systemd/system")[0]


def test_the_configuration_is_no_conffile_of_dpkg() -> None:
    # Every user changes the rig. For a changed conffile, dpkg would ask questions at every upgrade.
    assert not (DEBIAN / "conffiles").exists()
    assert "! -e /etc/jointfitd/rig.toml" in (DEBIAN / "postinst").read_text()
    assert '"$1" = purge' in (DEBIAN / "postrm").read_text()


def test_everything_that_the_virtual_machine_imports_exists() -> None:
    # The programs for the virtual machine are strings, which no type checker reads.
    found = [
        (module, name)
        for path in sorted((ROOT / "tests" / "vm_service").glob("*.py"))
        for module, name in re.findall(
            r"from (jointfit_[\w.]+) import (\w+)", path.read_text("utf-8")
        )
    ]
    assert found
    for module, name in found:
        assert hasattr(importlib.import_module(module), name), f"{module} has no {name}"


def test_every_option_of_the_daemon_is_in_its_manual_page() -> None:
    page = (MANUALS / "jointfitd.1").read_text().replace("\\-", "-")
    options = [name for action in _parser()._actions for name in action.option_strings]
    assert [name for name in options if name not in page] == []
    for code in ("0", "1", "2"):
        assert f".B {code}\n" in page


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_is_in_manual_page_and_index(command: str) -> None:
    page = (MANUALS / "jointfit.1").read_text("utf-8").replace("\\-", "-")
    assert re.search(rf'^\.BI? "?{command}[ "\n]', page, re.MULTILINE)
    index = (ROOT / "docs" / "index.md").read_text("utf-8")
    listed = re.search(r"Its commands are `(init [^`]*)`", index)
    assert listed is not None
    assert command in shlex.split(listed[1])


@pytest.mark.parametrize("page", sorted(MANUALS.glob("*.1")), ids=lambda page: page.name)
def test_manual_pages_are_sound(page: Path) -> None:
    if shutil.which("groff") is None:
        pytest.skip("groff is not installed (Debian: apt install groff-base)")
    done = subprocess.run(
        ["groff", "-man", "-Tutf8", "-ww", "-z", str(page)],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert (done.returncode, done.stderr) == (0, "")


KEYS = re.compile(
    rb"-----BEGIN [A-Z ]*PRIVATE KEY-----"
    rb"|\bAKIA[0-9A-Z]{16}\b"  # Amazon
    rb"|\bgh[pousr]_[A-Za-z0-9]{36}"  # GitHub
    rb"|\bglpat-[A-Za-z0-9_-]{20}"  # GitLab
    rb"|\bxox[baprs]-[A-Za-z0-9-]{10}"  # Slack
    rb"|\bpypi-[A-Za-z0-9_-]{50}"
    rb"|\bAIza[0-9A-Za-z_-]{35}"  # Google
    rb"|\beyJ[A-Za-z0-9_-]{20,}\.eyJ[A-Za-z0-9_-]{20,}\."  # a signed web token
    rb"|://[^\s/:@'\"{}<>]+:[^\s/:@'\"{}<>]{3,}@"  # a password in an address
)


def test_no_file_holds_a_key() -> None:
    here = Path(__file__).resolve()
    found = {
        path.relative_to(ROOT).as_posix(): match[0][:40]
        for path in tracked()
        if path != here and (match := KEYS.search(path.read_bytes()))
    }
    assert found == {}


@pytest.mark.parametrize(
    "text",
    [
        b"-----BEGIN EC PRIVATE KEY-----", b"ghp_" + b"a1" * 18, b"AKIA" + b"A1" * 8,
        b"mqtt://user:secret@broker",
    ],
)  # fmt: skip
def test_the_search_for_keys_finds_keys(text: bytes) -> None:
    assert KEYS.search(text)
