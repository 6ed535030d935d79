"""Error for recordings that cannot be processed as requested."""


class ReprocessingError(ValueError):
    """The recording does not fit the rig, calibration or request; the message states the remedy."""
