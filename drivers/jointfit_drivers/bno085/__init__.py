"""Driver for Bosch / CEVA BNO085 and BNO086 on a serial port, mode UART-RVC or UART-SHTP."""

from jointfit_drivers.bno085._driver import Bno085Imu
from jointfit_drivers.bno085._rvc_decoder import RvcDecoder
from jointfit_drivers.bno085._settings import Bno085Settings
from jointfit_drivers.bno085._shtp_decoder import ShtpDecoder

__all__ = ["Bno085Imu", "Bno085Settings", "RvcDecoder", "ShtpDecoder"]
