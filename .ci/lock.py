"""Print the installed distributions as constraints: what CI and `make` install, exactly.

Markers keep it right on other machines: a distribution that only some platforms need is pinned
there and ignored elsewhere, because a constraint installs nothing by itself.
"""

from importlib.metadata import distributions

SKIP = {"jointfitd", "pip", "setuptools", "wheel"}

if __name__ == "__main__":
    pins = {
        dist.metadata["Name"].lower().replace("_", "-"): dist.version for dist in distributions()
    }
    lines = [f"{name}=={version}" for name, version in sorted(pins.items()) if name not in SKIP]
