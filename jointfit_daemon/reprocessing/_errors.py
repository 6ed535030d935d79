"""The error of a recording that cannot be processed as requested."""


class ReprocessingError(ValueError):
    """A recording does not fit the rig, the calibration or the request; names cause and remedy."""
