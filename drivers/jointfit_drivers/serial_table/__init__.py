"""Driver for IMUs with binary frames or text lines on a serial port, described in rig.toml."""

from jointfit_drivers.serial_table._decoder import SerialTableDecoder
from jointfit_drivers.serial_table._driver import SerialTableImu
from jointfit_drivers.serial_table._settings import SerialTableSettings

__all__ = ["SerialTableDecoder", "SerialTableImu", "SerialTableSettings"]
