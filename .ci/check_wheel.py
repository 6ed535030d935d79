"""Build the wheel, install it in an empty environment, run the three commands from it."""

import subprocess
import sys
import tempfile
import venv
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
COMMANDS = (["jointfitd", "--version"], ["jointfit", "--help"], ["jointfit-sim", "--help"])
SHARED = ("lib/systemd/system/jointfitd.service", "lib/udev/rules.d/70-jointfitd.rules")


def run(*words: str | Path, cwd: Path) -> None:
    """Run a command away from the checkout, so that nothing is imported from there."""
    print("+", *words, flush=True)
    done = subprocess.run(  # noqa: S603 - our own commands
        [str(word) for word in words], cwd=cwd, text=True, check=False, capture_output=True
    )
    if done.returncode:
        sys.exit(f"{done.stdout}{done.stderr}ended with {done.returncode}")


def main() -> None:
    """Build, install, run; end with the output of the first step that fails."""
    with tempfile.TemporaryDirectory() as folder:
        work = Path(folder)
        run(sys.executable, "-m", "pip", "wheel", "--no-deps", "--wheel-dir", work, ROOT, cwd=work)
        venv.create(work / "venv", with_pip=True)
        binaries = work / "venv" / "bin"
        lock, wheel = ROOT / "requirements.lock", next(work.glob("jointfitd-*.whl"))
        run(binaries / "pip", "install", "--quiet", "--constraint", lock, wheel, cwd=work)
        for command, *arguments in COMMANDS:
            run(binaries / command, *arguments, cwd=work)
        example = ROOT / "examples" / "knee.toml"
        run(binaries / "jointfitd", "--config", example, "--check", cwd=work)
        missing = [name for name in SHARED if not (work / "venv" / name).is_file()]
        if missing:
            sys.exit(f"not in the wheel: {missing}")


if __name__ == "__main__":
    main()
