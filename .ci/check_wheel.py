"""Build wheels and sdist, check them, install each as a user would: `check_wheel.py [FOLDER]`.

Each archive is installed into an empty environment, the wheels by pip and the sdist by pipx. FOLDER
receives the archives. The compiled wheel is built if this machine has a C compiler and Python's
headers.
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
sys.path.insert(0, str(ROOT / "packaging"))

from compiled import compiler  # noqa: E402 - a folder of programs, no package

LOCK = ROOT / "requirements.lock"
EXAMPLE = ROOT / "examples" / "knee.toml"
COMMANDS = (["jointfitd", "--version"], ["jointfit", "--help"], ["jointfit-sim", "--help"])
PAGE = "jointfit_daemon/tools/dashboard/page"
"""Folder of the dashboard's page, which contains no Python."""
SHARED = (
    "lib/systemd/system/jointfitd.service",
    "lib/systemd/system/jointfitd@.service",
    "lib/udev/rules.d/70-jointfitd.rules",
    "share/man/man1/jointfitd.1",
)


def run(*words: str | Path, cwd: Path, **environment: str) -> str:
    """Run a command, usually outside the checkout, and return its output."""
    print("+", *words, flush=True)
    done = subprocess.run(  # noqa: S603 - our own commands
        [str(word) for word in words], cwd=cwd, text=True, check=False, capture_output=True,
        env=os.environ | environment,
    )  # fmt: skip
    if done.returncode:
        sys.exit(f"{done.stdout}{done.stderr}{words[0]} ended with {done.returncode}")
    return done.stdout


def build(folder: Path, *options: str, compiled: bool = False) -> None:
    """Write the archives of this checkout to `folder`."""
    words = ["-m", "hatchling", "build", "--directory", str(folder), *options]
    run(sys.executable, *words, cwd=ROOT, JOINTFIT_COMPILED=str(int(compiled)))


def try_out(binaries: Path, work: Path) -> None:
    """Run the installed commands."""
    for command, *arguments in COMMANDS:
        run(binaries / command, *arguments, cwd=work)
    run(binaries / "jointfitd", "--config", EXAMPLE, "--check", cwd=work)


def carry_the_page(wheel: Path) -> None:
    """Exit with an error if the wheel lacks a file of the dashboard's page."""
    with zipfile.ZipFile(wheel) as archive:
        packed = set(archive.namelist())
    files = {path for path in (ROOT / PAGE).rglob("*") if path.is_file()}
    missing = sorted({path.relative_to(ROOT).as_posix() for path in files} - packed)
    if missing or not files:
        sys.exit(f"not in {wheel.name}: {missing}")


def install(archive: Path, work: Path, variant: str) -> None:
    """Install an archive into an empty environment, and run its commands.

    The modules must be those of `variant`, and pure Python with ``JOINTFIT_PURE=1``.
    """
    home = work / f"venv-{variant}"
    venv.create(home, with_pip=True)
    run(home / "bin" / "pip", "install", "--quiet", "--constraint", LOCK, archive, cwd=work)
    try_out(home / "bin", work)
    for expected, pure in ((variant, "0"), ("pure", "1")):
        text = run(home / "bin" / "jointfitd", "--version", cwd=work, JOINTFIT_PURE=pure)
        if f"({expected})" not in text:
            sys.exit(f"{archive.name}, JOINTFIT_PURE={pure}: expected {expected}, found {text}")
    missing = [name for name in SHARED if not (home / name).is_file()]
    if missing:
        sys.exit(f"not in {archive.name}: {missing}")


def install_by_pipx(archive: Path, work: Path) -> None:
    """Install an archive with pipx, as a user would."""
    places = {"PIPX_HOME": str(work / "pipx"), "PIPX_BIN_DIR": str(work / "bin")}
    run(
        sys.executable, "-m", "pipx", "install", "--quiet", "--python", sys.executable,
        "--pip-args", f"--constraint {LOCK}", archive,
        cwd=work, **places, PIPX_MAN_DIR=str(work / "man"),
    )  # fmt: skip
    try_out(work / "bin", work)


def main() -> None:
    """Build, check, install and run the archives; exit with the output of the first failed step."""
    with tempfile.TemporaryDirectory() as folder:
        work = Path(folder)
        build(work / "first")
        build(work / "second")
        wheel, sdist = archives = sorted((work / "first").iterdir())
        for archive in archives:
            if archive.read_bytes() != (work / "second" / archive.name).read_bytes():
                sys.exit(f"{archive.name}: two builds differ")
        carry_the_page(wheel)
        install(wheel, work, "pure")
        install_by_pipx(sdist, work)

        if compiler() is None:
            print("no compiled wheel: the C compiler or the headers of Python are missing")
        else:
            build(work / "compiled", "--target", "wheel", compiled=True)
            (compiled,) = (work / "compiled").iterdir()
            install(compiled, work, "compiled")
            archives.append(compiled)
        run(sys.executable, "-m", "twine", "check", "--strict", *archives, cwd=work)
        for archive in archives:
            print(hashlib.sha256(archive.read_bytes()).hexdigest(), archive.name)
            if len(sys.argv) > 1:
                target = Path(sys.argv[1])
                target.mkdir(parents=True, exist_ok=True)
                shutil.copyfile(archive, target / archive.name)


if __name__ == "__main__":
    main()
