"""Print the installed distributions as constraints: what CI and `make` install, exactly.

A constraint installs nothing by itself: a line for something that a machine does not need is
without effect there.
"""

from importlib.metadata import distributions

SKIP = {"jointfitd", "pip", "setuptools", "wheel"}


def main() -> None:
    """Print one sorted line a distribution, but for the tools that every environment brings."""
    print("# Written by `make lock`: exact versions for CI and `make`, read as pip constraints.")
    pins = {
        dist.metadata["Name"].lower().replace("_", "-"): dist.version for dist in distributions()
    }
    for name, version in sorted(pins.items()):
        if name not in SKIP:
            print(f"{name}=={version}")


if __name__ == "__main__":
    main()
