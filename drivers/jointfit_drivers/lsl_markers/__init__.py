"""Driver for motion capture that arrives as a stream of the Lab Streaming Layer (LSL)."""

from jointfit_drivers.lsl_markers._decoder import LslMarkersDecoder
from jointfit_drivers.lsl_markers._driver import LslMarkersMocap
from jointfit_drivers.lsl_markers._settings import LslMarkersSettings

__all__ = ["LslMarkersDecoder", "LslMarkersMocap", "LslMarkersSettings"]
