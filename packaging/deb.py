#!/usr/bin/env python3
"""Build the Debian package: `python packaging/deb.py [--arch amd64|arm64] [--out DIR]`.

Invariant: the content depends only on ``requirements.lock``, the commit, and the Python, C compiler
and ``strip`` of this machine (their versions, and whether the last two are installed). The same
commit yields identical bytes. All dates are SOURCE_DATE_EPOCH, by default the time of the commit.
Wheels are only unpacked, so a package for another architecture can also be built. Only a package
for the architecture of this machine contains compiled modules (packaging/compiled.py), if a C
compiler exists.

The package contains its own site-packages, for all Python versions in `PYTHONS`: the names of
extension modules contain the Python version, and all other files are the same for all versions. Its
interpreter /usr/lib/jointfitd/bin/python3 is a link to Debian's Python. Other programs cannot
import packages of jointfitd. Of Debian's Python packages, jointfitd can import only those in
`FROM_DEBIAN`, through links.
"""

from __future__ import annotations

import argparse
import compileall
import gzip
import hashlib
import json
import os
import platform
import py_compile
import shutil
import subprocess
import sys
import tempfile
import tomllib
from email.utils import formatdate
from pathlib import Path

from compiled import compiler

ROOT = Path(__file__).resolve().parents[1]
DEBIAN = Path(__file__).with_name("debian")
HOME = Path("usr/lib/jointfitd")
PYTHON = f"{sys.version_info.major}.{sys.version_info.minor}"
"""Python version of this machine, for which the package contains compiled modules and bytecode."""
PYTHONS = ("3.11", "3.12", "3.13")
"""Python versions of Debian 12, Ubuntu 24.04 and Debian 13."""
FROM_DEBIAN = ("numpy", "scipy")
"""Libraries that Debian provides. They are three quarters of the size of all libraries."""
DEBIAN_PACKAGES = Path("/usr/lib/python3/dist-packages")
THIS_ARCHITECTURE = {"x86_64": "amd64", "aarch64": "arm64"}.get(platform.machine())
PLATFORMS = {
    "amd64": ("manylinux_2_28_x86_64", "manylinux_2_17_x86_64", "manylinux2014_x86_64"),
    "arm64": ("manylinux_2_28_aarch64", "manylinux_2_17_aarch64", "manylinux2014_aarch64"),
}
COMMANDS = {
    "jointfitd": "jointfit_daemon.__main__",
    "jointfit": "jointfit_daemon.tools.__main__",
    "jointfit-sim": "jointfit_simulators.__main__",
}
MAINTAINER = "The jointfitd authors <jointfitd@users.noreply.github.com>"
EXTRAS = "demo,c3d,metrics"
"""Extras in the package. Their dependencies are pure Python or have wheels for both architectures.
"""
LAUNCHER = """\
#!/usr/lib/jointfitd/bin/python3 -I
import sys

from {module} import main

if __name__ == "__main__":
    sys.exit(main())
"""
LOCAL_DRIVERS = "/usr/local/lib/jointfitd"
"""Folder for third-party drivers from `pip install --target`. It belongs to root, as /usr/local
does."""
SYSTEM_FILES = {
    "systemd/jointfitd.service": "usr/lib/systemd/system",
    "systemd/jointfitd@.service": "usr/lib/systemd/system",
    "systemd/70-jointfitd.rules": "usr/lib/udev/rules.d",
    "packaging/completions/jointfit.bash": "usr/share/bash-completion/completions",
    "systemd/jointfitd-can.conf": "usr/share/jointfitd/systemd",
    "systemd/jointfitd-realtime.conf": "usr/share/jointfitd/systemd",
    "systemd/80-jointfit-can0.network": "usr/share/jointfitd/networkd",
    "systemd/mosquitto/jointfitd.conf": "usr/share/jointfitd/mosquitto",
    "systemd/mosquitto/jointfitd.acl": "usr/share/jointfitd/mosquitto",
    "examples/knee.toml": "usr/share/jointfitd/examples",
    "requirements.lock": "usr/share/doc/jointfitd",
}


def main() -> int:
    """Build one package, and print its path."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--arch", choices=sorted(PLATFORMS), default="amd64")
    parser.add_argument("--out", type=Path, default=ROOT / "build" / "packages", metavar="DIR")
    parser.add_argument("--version", help="version of the package (default: that of the project)")
    options = parser.parse_args()
    version = options.version or f"{_project_version()}-1"
    epoch = os.environ.get("SOURCE_DATE_EPOCH") or _commit_time()
    with tempfile.TemporaryDirectory(prefix="jointfitd-deb-") as scratch:
        tree = Path(scratch) / "tree"
        _install_python(tree, Path(scratch), options.arch, epoch)
        _install_files(tree)
        _install_documents(tree, version, int(epoch))
        _write_control(tree, version, options.arch)
        _settle(tree, int(epoch))
        options.out.mkdir(parents=True, exist_ok=True)
        package = options.out / f"jointfitd_{version}_{options.arch}.deb"
        _run(["dpkg-deb", "--root-owner-group", "-Zzstd", "--build", tree, package], epoch)
    print(package)
    return 0


def _run(words: list[str | Path], epoch: str, **extra: str) -> None:
    environment = {**os.environ, "SOURCE_DATE_EPOCH": epoch, **extra}
    done = subprocess.run(  # noqa: S603 - our own commands
        [str(word) for word in words], env=environment, text=True, capture_output=True, check=False
    )
    if done.returncode:
        sys.exit(f"{done.stdout}{done.stderr}{words[0]} ended with {done.returncode}")


def _project_version() -> str:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    return str(project["version"])


def _commit_time() -> str:
    git = shutil.which("git")
    if git is not None:
        done = subprocess.run(  # noqa: S603 - our own command
            [git, "-C", ROOT, "log", "-1", "--format=%ct"],
            capture_output=True, text=True, check=False,
        )  # fmt: skip
        if done.returncode == 0 and done.stdout.strip():
            return done.stdout.strip()
    return str(int((ROOT / "pyproject.toml").stat().st_mtime))  # a source archive has no commit


def _install_python(tree: Path, scratch: Path, architecture: str, epoch: str) -> None:
    """Unpack the wheel of this project and its dependencies into the package's site-packages."""
    site = tree / HOME / "lib" / "python3" / "site-packages"
    site.mkdir(parents=True)
    is_compiled = architecture == THIS_ARCHITECTURE and compiler() is not None
    # The Python of this machine comes first, because the metadata of its wheel list the compiled
    # modules.
    for python in sorted(PYTHONS, key=PYTHON.__ne__):
        wheel = _build_wheel(scratch / f"wheel-{python}", epoch, is_compiled and python == PYTHON)
        unpacked = scratch / f"site-{python}"
        _unpack(wheel, unpacked, python, architecture, epoch)
        for leftover in ("bin", "share", "lib", "include"):  # remove scripts and data of wheels
            shutil.rmtree(unpacked / leftover, ignore_errors=True)
        _merge(unpacked, site)
        (tree / HOME / "lib" / f"python{python}").symlink_to("python3")
    for record in site.glob("*.dist-info/direct_url.json"):  # contains a path of this machine
        record.unlink()
    _drop_tests(site)
    _strip(site, architecture, epoch)
    for name in FROM_DEBIAN:
        (site / name).symlink_to(DEBIAN_PACKAGES / name)
    (site / "local-drivers.pth").write_text(f"{LOCAL_DRIVERS}\n")
    binaries = tree / HOME / "bin"
    binaries.mkdir(parents=True)
    (binaries / "python3").symlink_to("/usr/bin/python3")
    (tree / HOME / "pyvenv.cfg").write_text(
        "home = /usr/bin\ninclude-system-site-packages = false\n"
    )
    # Python does not compare the bytecode with the sources, because only the package manager
    # changes both. postinst compiles for other Python versions.
    mode = py_compile.PycInvalidationMode.UNCHECKED_HASH
    compileall.compile_dir(
        site, quiet=2, stripdir=str(tree), prependdir="/", invalidation_mode=mode, workers=1
    )


def _pip(*words: str | Path) -> list[str | Path]:
    return [sys.executable, "-m", "pip", "--disable-pip-version-check", *words]


def _build_wheel(folder: Path, epoch: str, is_compiled: bool) -> Path:
    """Build the wheel of this project and return its path."""
    words = _pip(
        "wheel", "--quiet", "--no-deps", "--no-build-isolation", "--wheel-dir", folder, ROOT
    )
    _run(words, epoch, JOINTFIT_COMPILED=str(int(is_compiled)))
    return next(folder.glob("jointfitd-*.whl"))


def _unpack(wheel: Path, site: Path, python: str, architecture: str, epoch: str) -> None:
    """Unpack a wheel of this project and the libraries that Debian does not provide."""
    names = list(PLATFORMS[architecture])
    if not wheel.name.endswith("-any.whl"):  # a compiled wheel has the platform tag of this machine
        names.append(f"linux_{platform.machine()}")
    install = _pip(
        "install", "--quiet", "--target", site, "--only-binary=:all:", "--no-compile",
        "--implementation", "cp", "--python-version", python,
        *(word for name in names for word in ("--platform", name)),
        "--constraint", ROOT / "requirements.lock",
    )  # fmt: skip
    report = site.with_suffix(".json")
    resolve: list[str | Path] = [
        "--dry-run",
        "--report",
        report,
        f"jointfitd[{EXTRAS}] @ {wheel.as_uri()}",
    ]
    _run([*install, *resolve], epoch)
    chosen = [
        (str(each["metadata"]["name"]), str(each["metadata"]["version"]))
        for each in json.loads(report.read_text(encoding="utf-8"))["install"]
    ]
    libraries = [
        f"{name}=={version}" for name, version in chosen if name not in {"jointfitd", *FROM_DEBIAN}
    ]
    _run([*install, "--no-deps", wheel, *libraries], epoch)


def _merge(source: Path, site: Path) -> None:
    """Move the files of one Python version into the site-packages of all versions."""
    for path in sorted(source.rglob("*")):
        name = path.relative_to(source)
        target = site / name
        if path.is_dir():
            continue
        if not target.exists():
            target.parent.mkdir(parents=True, exist_ok=True)
            path.replace(target)
        elif path.read_bytes() != target.read_bytes() and ".dist-info" not in str(name):
            sys.exit(f"{name} is not the same for all Python versions")


def _drop_tests(site: Path) -> None:
    """Remove the tests of the libraries, which are half of the files and never run."""
    for folder in sorted(site.glob("*/**/tests")):
        if folder.is_dir():
            shutil.rmtree(folder, ignore_errors=True)


def _strip(site: Path, architecture: str, epoch: str) -> None:
    """Remove debug symbols, as Debian does; they are nine tenths of the size of some wheels."""
    machine = {"amd64": "x86_64", "arm64": "aarch64"}[architecture]
    program = shutil.which(f"{machine}-linux-gnu-strip")
    if program is None:
        print(
            f"{machine}-linux-gnu-strip is missing, so the package is twice as large: "
            f"apt install binutils-{machine.replace('_', '-')}-linux-gnu",
            file=sys.stderr,
        )
        return
    for path in sorted(site.rglob("*.so")):
        _run([program, "--strip-unneeded", path], epoch)


def _install_files(tree: Path) -> None:
    for name, folder in SYSTEM_FILES.items():
        target = tree / folder
        target.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(ROOT / name, target / Path(name).name)
    binaries = tree / "usr" / "bin"
    binaries.mkdir(parents=True)
    for command, module in COMMANDS.items():
        launcher = binaries / command
        launcher.write_text(LAUNCHER.format(module=module))
        launcher.chmod(0o755)


def _install_documents(tree: Path, version: str, epoch: int) -> None:
    """Install manual pages, licence, changelogs and lintian's exceptions at the paths of Debian."""
    documents, manuals = tree / "usr/share/doc/jointfitd", tree / "usr/share/man/man1"
    manuals.mkdir(parents=True)
    for page in sorted((DEBIAN.parent / "man").glob("*.1")):
        _compress(manuals / f"{page.name}.gz", page.read_bytes())
    terms = (ROOT / "LICENSE").read_text(encoding="utf-8").partition("\n\n")[2]
    indented = "".join(f" {line or '.'}\n" for line in terms.rstrip().splitlines())
    text = (DEBIAN / "copyright").read_text(encoding="utf-8").rstrip("\n")
    (documents / "copyright").write_text(f"{text}\n{indented}", encoding="utf-8")
    _compress(documents / "changelog.gz", (ROOT / "CHANGELOG.md").read_bytes())
    overrides = tree / "usr/share/lintian/overrides"
    overrides.mkdir(parents=True)
    shutil.copyfile(DEBIAN / "lintian-overrides", overrides / "jointfitd")
    entry = (
        f"jointfitd ({version}) stable; urgency=medium\n\n  * See changelog.gz.\n\n"
        f" -- {MAINTAINER}  {formatdate(epoch)}\n"
    )
    _compress(documents / "changelog.Debian.gz", entry.encode())


def _compress(path: Path, content: bytes) -> None:
    path.write_bytes(gzip.compress(content, 9, mtime=0))


def _write_control(tree: Path, version: str, architecture: str) -> None:
    size = sum(path.lstat().st_size for path in tree.rglob("*") if not path.is_dir())
    control = tree / "DEBIAN"
    control.mkdir()
    major, minor = PYTHONS[-1].split(".")
    text = (DEBIAN / "control").read_text(encoding="utf-8")
    (control / "control").write_text(
        text.format(
            version=version, architecture=architecture, kilobytes=size // 1024,
            maintainer=MAINTAINER, python=PYTHONS[0], next_python=f"{major}.{int(minor) + 1}",
        )
    )  # fmt: skip
    (control / "md5sums").write_text(_md5sums(tree), encoding="utf-8")
    for name in ("postinst", "prerm", "postrm"):
        script = (DEBIAN / name).read_text(encoding="utf-8")
        script = script.replace("@BYTECODE@", str(sys.implementation.cache_tag))
        (control / name).write_text(script, encoding="utf-8")
        (control / name).chmod(0o755)


def _md5sums(tree: Path) -> str:
    """Return the checksums that `dpkg --verify` compares with the installed files."""
    files = [path for path in sorted(tree.rglob("*")) if path.is_file() and not path.is_symlink()]
    return "".join(
        f"{hashlib.md5(path.read_bytes()).hexdigest()}  {name}\n"  # noqa: S324 - dpkg's format
        for path in files
        if not (name := path.relative_to(tree).as_posix()).startswith("DEBIAN/")
    )


def _settle(tree: Path, epoch: int) -> None:
    """Set the permissions and the date of every file."""
    for path in sorted(tree.rglob("*"), reverse=True):
        if not path.is_symlink():
            executable = path.is_dir() or path.stat().st_mode & 0o100
            path.chmod(0o755 if executable else 0o644)
        os.utime(path, (epoch, epoch), follow_symlinks=False)


if __name__ == "__main__":
    sys.exit(main())
