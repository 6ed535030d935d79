#!/usr/bin/env python3
"""Write the software bill of materials: `python packaging/sbom.py [--out DIR]`.

Invariant: the list contains the installed packages, not the requested packages. The project and the
extras of the Debian package are installed into an empty environment, which is then listed as
CycloneDX JSON. The same versions yield identical bytes.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
from pathlib import Path

from deb import EXTRAS, FROM_DEBIAN, ROOT

TOOL = Path(sys.executable).with_name("cyclonedx-py")


def main() -> int:
    """Write the list, and print its path."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--out", type=Path, default=ROOT / "build" / "packages", metavar="DIR")
    out: Path = parser.parse_args().out.resolve()
    out.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix="jointfitd-sbom-") as scratch:
        empty = Path(scratch) / "venv"
        _run(sys.executable, "-m", "venv", "--without-pip", empty)
        _run(
            sys.executable, "-m", "pip", "--disable-pip-version-check",
            "--python", empty / "bin" / "python", "install", "--quiet",
            "--constraint", ROOT / "requirements.lock", f"{ROOT}[{EXTRAS}]",
        )  # fmt: skip
        # The Debian package does not contain these libraries.
        _run(
            sys.executable, "-m", "pip", "--disable-pip-version-check",
            "--python", empty / "bin" / "python", "uninstall", "--quiet", "--yes", *FROM_DEBIAN,
        )  # fmt: skip
        _run(
            TOOL, "environment", "--pyproject", ROOT / "pyproject.toml", "--output-reproducible",
            "--output-format", "JSON", "--output-file", out / "jointfitd.cdx.json",
            empty / "bin" / "python",
        )  # fmt: skip
    print(out / "jointfitd.cdx.json")
    return 0


def _run(*words: str | Path) -> None:
    done = subprocess.run(  # noqa: S603 - our own commands
        [str(word) for word in words], text=True, capture_output=True, check=False
    )
    if done.returncode:
        sys.exit(f"{done.stdout}{done.stderr}{words[0]} ended with {done.returncode}")


if __name__ == "__main__":
    sys.exit(main())
