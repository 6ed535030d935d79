"""Driver for Qualisys Track Manager (QTM) by its real-time protocol."""

from jointfit_drivers.qtm._decoder import QtmDecoder
from jointfit_drivers.qtm._driver import QtmMocap
from jointfit_drivers.qtm._settings import QtmSettings

__all__ = ["QtmDecoder", "QtmMocap", "QtmSettings"]
