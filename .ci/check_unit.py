"""Check the systemd unit: systemd can read it, and its exposure stays at or under 1.5."""

import shutil
import subprocess
import sys
from pathlib import Path

UNIT = Path(__file__).resolve().parents[1] / "systemd" / "jointfitd.service"
THRESHOLD = "15"  # tenths, as systemd-analyze counts
ELSEWHERE = "/usr/bin/jointfitd"
"""What ExecStart names; it is not installed where the unit is only checked."""


def analyze(*arguments: str) -> subprocess.CompletedProcess[str]:
    """Run systemd-analyze on the unit."""
    return subprocess.run(  # noqa: S603 - a fixed command on our own file
        [shutil.which("systemd-analyze") or "systemd-analyze", *arguments, str(UNIT)],
        capture_output=True,
        text=True,
        check=False,
    )


def main() -> int:
    """Print what is wrong; 1 if anything is."""
    if shutil.which("systemd-analyze") is None:
        print("systemd-analyze is not installed: apt install systemd")
        return 1
    said = analyze("verify").stderr.splitlines()
    wrong = [line for line in said if UNIT.name in line and ELSEWHERE not in line]
    print(*wrong, sep="\n", end="\n" if wrong else "")
    security = analyze("security", "--offline=yes", f"--threshold={THRESHOLD}", "--no-pager")
    print(*security.stdout.splitlines()[-1:], security.stderr.strip())
    return 1 if wrong or security.returncode else 0


if __name__ == "__main__":
    sys.exit(main())
