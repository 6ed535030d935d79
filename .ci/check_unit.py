"""Check that systemd can read our units and drop-ins, and that no exposure level exceeds 1.2.

The exposure level is the result of `systemd-analyze security`.
"""

import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

SYSTEMD = Path(__file__).resolve().parents[1] / "systemd"
UNITS = sorted(SYSTEMD.glob("jointfitd*.service"))
DROP_INS = sorted(SYSTEMD.glob("jointfitd*.conf"))
THRESHOLD = "12"  # tenths, as in systemd-analyze
ELSEWHERE = "/usr/bin/jointfitd"
"""Program in ExecStart. Messages that name it are ignored, because the machine that checks the
unit may lack it."""


def analyze(unit: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    """Run systemd-analyze on a unit."""
    return subprocess.run(  # noqa: S603 - a fixed command on our own file
        [shutil.which("systemd-analyze") or "systemd-analyze", *arguments, str(unit)],
        capture_output=True,
        text=True,
        check=False,
    )


def complaints(unit: Path) -> list[str]:
    """Return the defects of a unit; print its exposure level."""
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(shutil.copy(unit, folder))
        drop_ins = Path(f"{copy}.d")
        drop_ins.mkdir()
        for drop_in in DROP_INS:
            shutil.copy(drop_in, drop_ins)
        lines = analyze(copy, "verify", "--man=no").stderr.splitlines()
    wrong = [line for line in lines if "jointfitd" in line and ELSEWHERE not in line]
    security = analyze(unit, "security", "--offline=yes", f"--threshold={THRESHOLD}", "--no-pager")
    print(*security.stdout.splitlines()[-1:], security.stderr.strip())
    return wrong + ([f"{unit.name}: exposure level too high"] if security.returncode else [])


def main() -> int:
    """Print the defects; return 1 if there are any."""
    if shutil.which("systemd-analyze") is None:
        print("systemd-analyze is not installed: apt install systemd")
        return 1
    wrong = [line for unit in UNITS for line in complaints(unit)]
    print(*wrong, sep="\n", end="\n" if wrong else "")
    return 1 if wrong or not UNITS else 0


if __name__ == "__main__":
    sys.exit(main())
