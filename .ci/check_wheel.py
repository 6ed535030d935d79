"""Build wheel and sdist, check both, install each as a user would: `check_wheel.py [FOLDER]`.

Both into empty environments: the wheel by pip, the sdist by pipx. With FOLDER what was built is
kept there.
"""

import hashlib
import os
import shutil
import subprocess
import sys
import tempfile
import venv
import zipfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
LOCK = ROOT / "requirements.lock"
EXAMPLE = ROOT / "examples" / "knee.toml"
COMMANDS = (["jointfitd", "--version"], ["jointfit", "--help"], ["jointfit-sim", "--help"])
PAGE = "jointfit_daemon/tools/dashboard/page"
"""Folder of the dashboard's page, which is no Python."""
SHARED = (
    "lib/systemd/system/jointfitd.service",
    "lib/systemd/system/jointfitd@.service",
    "lib/udev/rules.d/70-jointfitd.rules",
    "share/man/man1/jointfitd.1",
)


def run(*words: str | Path, cwd: Path, **environment: str) -> None:
    """Run a command away from the checkout, so that nothing is imported from there."""
    print("+", *words, flush=True)
    done = subprocess.run(  # noqa: S603 - our own commands
        [str(word) for word in words], cwd=cwd, text=True, check=False, capture_output=True,
        env=os.environ | environment,
    )  # fmt: skip
    if done.returncode:
        sys.exit(f"{done.stdout}{done.stderr}ended with {done.returncode}")


def build(folder: Path) -> list[Path]:
    """Return the wheel and the sdist of this checkout."""
    words = ["-m", "hatchling", "build", "--directory", str(folder)]
    print("+ python", *words, flush=True)
    done = subprocess.run(  # noqa: S603 - our own command
        [sys.executable, *words], cwd=ROOT, text=True, capture_output=True, check=False
    )
    if done.returncode:
        sys.exit(f"{done.stdout}{done.stderr}ended with {done.returncode}")
    return [next(folder.glob("*.whl")), next(folder.glob("*.tar.gz"))]


def try_out(binaries: Path, work: Path) -> None:
    """Run the commands that were installed."""
    for command, *arguments in COMMANDS:
        run(binaries / command, *arguments, cwd=work)
    run(binaries / "jointfitd", "--config", EXAMPLE, "--check", cwd=work)


def carry_the_page(wheel: Path) -> None:
    """End unless the wheel contains every file of the dashboard's page."""
    with zipfile.ZipFile(wheel) as archive:
        packed = set(archive.namelist())
    files = {path for path in (ROOT / PAGE).rglob("*") if path.is_file()}
    missing = sorted({path.relative_to(ROOT).as_posix() for path in files} - packed)
    if missing or not files:
        sys.exit(f"not in {wheel.name}: {missing}")


def install(archive: Path, work: Path) -> None:
    """Install into an empty environment and try it."""
    home = work / "venv"
    venv.create(home, with_pip=True)
    run(home / "bin" / "pip", "install", "--quiet", "--constraint", LOCK, archive, cwd=work)
    try_out(home / "bin", work)
    missing = [name for name in SHARED if not (home / name).is_file()]
    if missing:
        sys.exit(f"not in {archive.name}: {missing}")


def install_by_pipx(archive: Path, work: Path) -> None:
    """Install as a program of a user."""
    places = {"PIPX_HOME": str(work / "pipx"), "PIPX_BIN_DIR": str(work / "bin")}
    run(
        sys.executable, "-m", "pipx", "install", "--quiet", "--python", sys.executable,
        "--pip-args", f"--constraint {LOCK}", archive,
        cwd=work, **places, PIPX_MAN_DIR=str(work / "man"),
    )  # fmt: skip
    try_out(work / "bin", work)


def main() -> None:
    """Build, check, install, run; end with the output of the first step that fails."""
    with tempfile.TemporaryDirectory() as folder:
        work = Path(folder)
        wheel, sdist = build(work / "first")
        for one, other in zip((wheel, sdist), build(work / "second"), strict=True):
            if one.read_bytes() != other.read_bytes():
                sys.exit(f"{one.name}: two builds differ")
        carry_the_page(wheel)
        run(sys.executable, "-m", "twine", "check", "--strict", sdist, wheel, cwd=work)
        install(wheel, work)
        install_by_pipx(sdist, work)
        for archive in (wheel, sdist):
            print(hashlib.sha256(archive.read_bytes()).hexdigest(), archive.name)
            if len(sys.argv) > 1:
                target = Path(sys.argv[1])
                target.mkdir(parents=True, exist_ok=True)
                shutil.copyfile(archive, target / archive.name)


if __name__ == "__main__":
    main()
