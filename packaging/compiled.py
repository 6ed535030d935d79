#!/usr/bin/env python3
"""Compile the modules that compute each frame: `python packaging/compiled.py [--out DIR]`.

The compiler is mypyc. The command writes the packages as a wheel would install them, with sources
and extension modules, into DIR (default: build/compiled). This file is also the build hook of the
wheel. With ``JOINTFIT_COMPILED=1`` the hook adds the extension modules to the wheel. Otherwise,
wheels and editable installations are pure Python. The modules to compile are listed in
pyproject.toml. They are compiled again only if a source, the list, the compiler or mypy has
changed.

Invariant: the sources are compiled without changes. A wheel contains the sources and the compiled
modules.
"""

from __future__ import annotations

import argparse
import hashlib
import importlib.metadata
import os
import platform
import shutil
import subprocess
import sys
import sysconfig
import tomllib
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

ROOT = Path(__file__).resolve().parents[1]
OUT = ROOT / "build" / "compiled"
PACKAGES = (
    "jointfit_daemon",
    "drivers/jointfit_drivers",
    "protocols/jointfit_protocols",
    "simulators/jointfit_simulators",
)
VARIANT = "jointfit_variant.py"
STAMP = ".digest"
REQUIREMENTS = ["mypy[mypyc]>=2.4,<3", "setuptools>=65", "numpy>=1.26", "typing-extensions>=4.4"]
"""Packages that the compilation needs. numpy provides types."""
MYPY = """\
[mypy]
explicit_package_bases = true
follow_imports = silent
ignore_missing_imports = true

# No compiled module calls these libraries once per frame. Analysing them would double the time.
[mypy-scipy.*,pydantic.*,mcap.*,can.*,serial.*,aiomqtt.*,paho.*,typer.*,rich.*,websockets.*]
follow_imports = skip
"""
SETUP = """\
import sys

from mypyc.build import mypycify
from setuptools import setup

level, *modules = sys.argv[1:]
extensions = mypycify(
    ["--config-file", "mypy.ini", *modules],
    opt_level=level, debug_level="0", multi_file=True, group_name="jointfit",
)
for extension in extensions:
    # a fused multiply-add, as on arm64, rounds once; the interpreter rounds twice
    extension.extra_compile_args = [*(extension.extra_compile_args or []), "-ffp-contract=off"]
    extension.extra_link_args = [*(extension.extra_link_args or []), "-s"]
arguments = ["--quiet", "build_ext", "--inplace", "--build-temp", "objects"]
setup(name="jointfit", packages=[], ext_modules=extensions, script_args=arguments)
"""
"""Program that compiles the modules. Each module has its own C file, because a single C file for
all modules would need a gigabyte of memory."""
LEVEL = "2"
"""Optimization level of the C compiler."""


def compiler() -> str | None:
    """Return the path of the C compiler; None if the compiler or Python's headers are missing."""
    words = os.environ.get("CC", "cc").split() or ["cc"]
    found = shutil.which(words[0])
    headers = Path(sysconfig.get_path("include"), "Python.h")
    return found if headers.is_file() else None


def module_list(root: Path = ROOT) -> dict[str, list[str]]:
    """Return the file patterns of the modules to compile, by group, from pyproject.toml."""
    project = tomllib.loads((root / "pyproject.toml").read_text(encoding="utf-8"))
    target = project["tool"]["hatch"]["build"]["targets"]["wheel"]
    groups: dict[str, list[str]] = target["hooks"]["custom"]["modules"]
    return groups


def is_current(out: Path, groups: dict[str, list[str]] | None = None, level: str = LEVEL) -> bool:
    """Return whether `out` contains extension modules of the current sources."""
    stamp = out / STAMP
    if not stamp.is_file() or compiler() is None:
        return False
    return stamp.read_text(encoding="utf-8") == _digest(groups or module_list(), level)


def compile_modules(out: Path, groups: dict[str, list[str]], level: str = LEVEL) -> Path:
    """Write the packages with extension modules to `out`, unless they are current.

    Raises
    ------
    RuntimeError
        The C compiler or Python's headers are missing, or a module cannot be compiled.
    """
    if compiler() is None:
        raise RuntimeError(
            "the C compiler or the headers of Python are missing"
            " (Debian: sudo apt install gcc python3-dev)"
        )
    if is_current(out, groups, level):
        return out

    digest = _digest(groups, level)  # computed first: a source may change during compilation
    work = out.with_name(f"{out.name}.new")
    shutil.rmtree(work, ignore_errors=True)
    work.mkdir(parents=True)
    for package in PACKAGES:
        ignored = shutil.ignore_patterns("__pycache__", "*.so")
        shutil.copytree(ROOT / package, work / Path(package).name, ignore=ignored)
    shutil.copyfile(ROOT / VARIANT, work / VARIANT)
    modules = _modules(work, groups)

    (work / "mypy.ini").write_text(MYPY, encoding="utf-8")
    (work / "setup.py").write_text(SETUP, encoding="utf-8")
    done = subprocess.run(  # noqa: S603 - our own program
        [sys.executable, "setup.py", level, *modules],
        cwd=work, text=True, capture_output=True, check=False,
        env=os.environ | {"PYTHONHASHSEED": "0"},  # the order of sets affects the C files
    )  # fmt: skip
    if done.returncode:
        raise RuntimeError(f"{done.stdout}{done.stderr}compiling ended with {done.returncode}")

    for leftover in ("build", "objects", ".mypy_cache"):
        shutil.rmtree(work / leftover, ignore_errors=True)
    for name in ("mypy.ini", "setup.py"):
        (work / name).unlink()
    (work / STAMP).write_text(digest, encoding="utf-8")
    shutil.rmtree(out, ignore_errors=True)
    return work.rename(out)


def _modules(tree: Path, groups: dict[str, list[str]]) -> list[str]:
    """Return the paths in `tree` that match the patterns of all groups, sorted."""
    found: set[str] = set()
    for pattern in (pattern for patterns in groups.values() for pattern in patterns):
        paths = {path.relative_to(tree).as_posix() for path in tree.glob(pattern)}
        if not paths:
            raise RuntimeError(f"pyproject.toml: no module matches {pattern}")
        found |= paths
    return sorted(found)


def _digest(groups: dict[str, list[str]], level: str) -> str:
    """Return a hash of all inputs of the extension modules."""
    version = subprocess.run(  # noqa: S603 - the compiler
        [compiler() or "cc", "--version"], capture_output=True, text=True, check=False
    ).stdout
    tools = [importlib.metadata.version(name) for name in ("mypy", "setuptools", "numpy")]
    hashed = hashlib.sha256(repr((sys.version, version, tools, groups, level)).encode())
    sources = [path for package in PACKAGES for path in sorted((ROOT / package).rglob("*.py"))]
    for path in (*sources, ROOT / VARIANT, Path(__file__)):
        hashed.update(path.relative_to(ROOT).as_posix().encode() + path.read_bytes())
    return hashed.hexdigest()


class CompiledBuildHook(BuildHookInterface):  # type: ignore[type-arg]
    """Build hook of hatchling that adds the extension modules to a wheel."""

    def dependencies(self) -> list[str]:  # type: ignore[explicit-override]  # standard library only
        """Return the packages of the build environment."""
        return REQUIREMENTS if self._active("standard") else []

    def initialize(  # type: ignore[explicit-override]
        self, version: str, build_data: dict[str, Any]
    ) -> None:
        """Compile, and add the extension modules; `version` is ``standard`` or ``editable``."""
        if not self._active(version):
            return
        tree = compile_modules(OUT, module_list())
        build_data["pure_python"], build_data["infer_tag"] = False, True
        for path in sorted(tree.rglob(f"*{sysconfig.get_config_var('EXT_SUFFIX')}")):
            build_data["force_include"][str(path)] = path.relative_to(tree).as_posix()

    def _active(self, version: str) -> bool:
        wanted = os.environ.get("JOINTFIT_COMPILED", "0") not in {"", "0"}
        return wanted and self.target_name == "wheel" and version == "standard"


def main() -> int:
    """Compile the modules into a folder, and print how to use it."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--out", type=Path, default=OUT, metavar="DIR")
    parser.add_argument("--level", default=LEVEL, help="optimization of the C compiler, 0 to 3")
    parser.add_argument("--groups", nargs="+", metavar="GROUP", help="modules (default: all)")
    parser.add_argument("--check", action="store_true", help="exit with 0 if DIR is current")
    options = parser.parse_args()
    groups = module_list()
    chosen = {name: groups[name] for name in options.groups or groups}
    if options.check:
        return 0 if is_current(options.out, chosen, options.level) else 1
    try:
        tree = compile_modules(options.out.resolve(), chosen, options.level)
    except RuntimeError as error:
        sys.exit(str(error))
    print(f"{tree}: compiled for Python {platform.python_version()}")
    print(f"use it with PYTHONPATH={tree}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
