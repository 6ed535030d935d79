"""Query the Python vulnerability service for the distributions of requirements.lock.

An unreachable service is reported and does not fail the check.
"""

import json
import socket
import subprocess
import sys
from pathlib import Path

LOCK = Path(__file__).resolve().parents[1] / "requirements.lock"
SERVICE = ("pypi.org", 443)
PATIENCE_S = 10.0


def main() -> int:
    """Print the known vulnerabilities; return 1 if there are any."""
    try:
        socket.create_connection(SERVICE, PATIENCE_S).close()
    except OSError as error:
        print(f"not audited: {SERVICE[0]} cannot be reached: {error}")
        return 0
    done = subprocess.run(  # noqa: S603 - a fixed command
        [
            sys.executable, "-m", "pip_audit", "--requirement", str(LOCK), "--no-deps",
            "--disable-pip", "--progress-spinner", "off", "--format", "json",
        ],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    try:
        found = json.loads(done.stdout)["dependencies"]
    except (ValueError, KeyError):
        reason = done.stderr.strip().splitlines()[-1:] or ["no answer"]
        print(f"not audited: {reason[0]}")
        return 0
    known = [
        f"{item['name']} {item['version']}: {hole['id']}, fixed in "
        f"{', '.join(hole['fix_versions']) or 'no release yet'}"
        for item in found
        for hole in item.get("vulns", [])
    ]
    print(*known, f"{len(found)} distributions, {len(known)} known vulnerabilities", sep="\n")
    return 1 if known else 0


if __name__ == "__main__":
    sys.exit(main())
