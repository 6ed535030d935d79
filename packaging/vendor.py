"""Fetch the vendored scripts of the dashboard again: `python packaging/vendor.py`.

The file `vendored_scripts.json` lists packages, versions, licences, files and their SHA-256. Each
package is fetched by `npm pack`, which runs no script of the package. A file with another checksum
is not written.
"""

from __future__ import annotations

import hashlib
import json
import shutil
import subprocess
import sys
import tarfile
import tempfile
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
MANIFEST = Path(__file__).with_name("vendored_scripts.json")
VENDOR = ROOT / "jointfit_daemon/tools/dashboard/page/vendor"


def fetch(package: dict[str, Any], folder: Path) -> dict[str, bytes]:
    """Return the files of a package, by their names in the vendor folder."""
    npm = shutil.which("npm")
    if npm is None:
        sys.exit("npm is not installed (Debian: apt install npm)")
    name = f"{package['name']}@{package['version']}"
    done = subprocess.run(  # noqa: S603 - names from our own manifest
        [npm, "pack", "--silent", "--pack-destination", str(folder), name],
        capture_output=True, text=True, check=False, cwd=folder,
    )  # fmt: skip
    if done.returncode:
        sys.exit(f"{done.stderr}npm pack {name} ended with {done.returncode}")

    found = {}
    with tarfile.open(folder / done.stdout.split()[-1]) as archive:
        for target, entry in package["files"].items():
            member = archive.extractfile(f"package/{entry['source']}")
            content = b"" if member is None else member.read()
            digest = hashlib.sha256(content).hexdigest()
            if digest != entry["sha256"]:
                sys.exit(
                    f"{name}: {entry['source']} has SHA-256 {digest}, expected {entry['sha256']}:"
                    f" for a new version, review the file and change {MANIFEST.name}"
                )
            found[target] = content
    return found


def main() -> None:
    """Fetch and write all files; exit with an error at the first different file."""
    manifest = json.loads(MANIFEST.read_text(encoding="utf-8"))
    with tempfile.TemporaryDirectory(prefix="jointfit-vendor-") as folder:
        for package in manifest["packages"]:
            for name, content in fetch(package, Path(folder)).items():
                (VENDOR / name).write_bytes(content)
                print(f"{name}: {package['name']} {package['version']}, {package['license']}")


if __name__ == "__main__":
    main()
