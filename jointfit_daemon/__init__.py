"""Joint positions and angles from body-worn IMUs in real time."""

from importlib.metadata import PackageNotFoundError, version

try:
    __version__ = version("jointfitd")
except PackageNotFoundError:  # a checkout that is not installed
    __version__ = "0+unknown"
