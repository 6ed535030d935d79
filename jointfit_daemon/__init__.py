"""Joint positions and angles from body-worn IMUs in real time."""

from jointfit_variant import select_variant

select_variant(__path__)


def __getattr__(name: str) -> str:
    """Return ``__version__``, which is read on demand because the metadata is slow to load."""
    if name != "__version__":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from importlib.metadata import PackageNotFoundError, version  # noqa: PLC0415 - on demand

    try:
        return version("jointfitd")
    except PackageNotFoundError:  # a checkout that is not installed
        return "0+unknown"
