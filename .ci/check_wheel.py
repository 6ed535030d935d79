"""Build the wheel, install it in an empty environment, run the three commands from it."""

import subprocess
import sys
import tempfile
import venv
from pathlib import Path

ROOT = Path(__file__).parents[1]
COMMANDS = (["jointfitd", "--version"], ["jointfit", "--help"], ["jointfit-sim", "--help"])


def run(*words: str | Path) -> None:
    subprocess.run([str(word) for word in words], check=True, stdout=subprocess.DEVNULL)  # noqa: S603 - our own commands


def main() -> int:
    with tempfile.TemporaryDirectory() as folder:
        work = Path(folder)
        run(sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--wheel-dir", work, ROOT)
        wheel = next(work.glob("jointfitd-*.whl"))
        venv.create(work / "venv", with_pip=True)
        binaries = work / "venv" / "bin"
        constraint = ROOT / "requirements.lock"
        run(binaries / "pip", "install", "--quiet", "--constraint", constraint, wheel)
        for command, *arguments in COMMANDS:
            run(binaries / command, *arguments)
        example = ROOT / "examples" / "knee.toml"
        run(binaries / "jointfitd", "--config", example, "--check")
    return 0


if __name__ == "__main__":
    sys.exit(main())
