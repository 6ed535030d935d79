"""Print the installed distributions as constraints: the exact versions for CI and `make`.

A constraint does not install a package, so a line for an unneeded package has no effect. Every
listed release must support every Python version of the project. For example, Debian 12 has Python
3.11.2, and a release that requires 3.11.5 cannot be installed there.
"""

import sys
import tomllib
from importlib.metadata import Distribution, distributions
from pathlib import Path

from packaging.specifiers import SpecifierSet

PROJECT = Path(__file__).resolve().parents[1] / "pyproject.toml"
SKIP = {"jointfitd", "pip", "setuptools", "wheel"}


def name_of(dist: Distribution) -> str:
    """Return the normalised name of a distribution."""
    return dist.metadata["Name"].lower().replace("_", "-")


def main() -> None:
    """Print one sorted line per distribution; exit with 1 if one needs a newer Python."""
    project = tomllib.loads(PROJECT.read_text(encoding="utf-8"))["project"]
    oldest = project["requires-python"].removeprefix(">=") + ".0"
    locked = sorted((dist for dist in distributions() if name_of(dist) not in SKIP), key=name_of)
    wrong = [
        f"{name_of(dist)} {dist.version} needs Python {wanted}: install an older release first"
        for dist in locked
        if (wanted := dist.metadata.json.get("requires_python"))
        and not SpecifierSet(str(wanted)).contains(oldest)
    ]
    if wrong:
        sys.exit("\n".join(wrong))
    print("# Written by `make lock`: exact versions for CI and `make`, read as pip constraints.")
    for dist in locked:
        print(f"{name_of(dist)}=={dist.version}")


if __name__ == "__main__":
    main()
