"""Check Debian packages without installing them: `check_deb.py PACKAGE...`.

A package has at most `LARGEST` bytes. Every library must have the architecture of the package,
every file must be listed with its checksum, and no file may contain paths of the machine that built
it.
"""

import hashlib
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
MACHINES = {"amd64": 62, "arm64": 183}
"""Values of the ELF field e_machine for x86-64 and AArch64."""
LARGEST = 40_000_000
"""Largest size of a package, bytes."""
NEEDED = (
    "usr/bin/jointfitd", "usr/lib/systemd/system/jointfitd.service",
    "usr/lib/udev/rules.d/70-jointfitd.rules", "usr/share/man/man1/jointfitd.1.gz",
    "usr/share/bash-completion/completions/jointfit.bash", "usr/share/doc/jointfitd/copyright",
    "usr/share/doc/jointfitd/changelog.Debian.gz",
)  # fmt: skip


def faults(package: Path) -> Iterator[str]:
    """Yield the defects of a package."""
    if (size := package.stat().st_size) > LARGEST:
        yield f"{size} bytes, at most {LARGEST} are allowed"
    with tempfile.TemporaryDirectory(prefix="check-deb-") as folder:
        tree = Path(folder)
        subprocess.run(["dpkg-deb", "-R", str(package), folder], check=True)  # noqa: S603, S607 - Debian's
        control = (tree / "DEBIAN" / "control").read_text(encoding="utf-8")
        fields = dict(line.split(": ", 1) for line in control.splitlines() if line[0] != " ")
        machine = MACHINES[fields["Architecture"]]
        sums = dict(
            line.split("  ", 1)[::-1]
            for line in (tree / "DEBIAN" / "md5sums").read_text(encoding="utf-8").splitlines()
        )
        yield from (f"{name} is missing" for name in NEEDED if name not in sums)
        if not any(name.endswith("/tools/dashboard/page/index.html") for name in sums):
            yield "the page of the dashboard is missing"
        files = [path for path in tree.rglob("*") if path.is_file() and not path.is_symlink()]
        for path in files:
            name = path.relative_to(tree).as_posix()
            if not name.startswith("DEBIAN/"):
                yield from faults_of(name, path.read_bytes(), machine, sums.pop(name, ""))
        yield from (f"{name}: in md5sums, but not in the package" for name in sums)


def faults_of(name: str, content: bytes, machine: int, md5: str) -> Iterator[str]:
    """Yield the defects of one file in a package."""
    if hashlib.md5(content).hexdigest() != md5:  # noqa: S324 - dpkg's format
        yield f"{name}: checksum differs from md5sums"
    if content[:4] == b"\x7fELF" and int.from_bytes(content[18:20], "little") != machine:
        yield f"{name}: built for another architecture"
    if str(ROOT).encode() in content or b"/tmp/jointfitd-deb-" in content:
        yield f"{name}: names a folder of the machine that built it"


def main() -> int:
    """Print the defects; return 1 if there are any."""
    packages = [Path(word) for word in sys.argv[1:]]
    wrong = [f"{package.name}: {fault}" for package in packages for fault in faults(package)]
    print(*wrong, f"{len(packages)} packages, {len(wrong)} faults", sep="\n")
    return 1 if wrong or not packages else 0


if __name__ == "__main__":
    sys.exit(main())
