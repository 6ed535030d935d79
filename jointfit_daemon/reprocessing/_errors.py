"""Error for recordings that cannot be processed as requested."""


class ReprocessingError(ValueError):
    """A recording does not fit rig, calibration or request; the message gives the remedy."""
