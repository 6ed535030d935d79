"""Driver for x-io x-IMU3 on a serial port or USB, and for boards that send its messages."""

from jointfit_drivers.ximu3._decoder import XImu3Decoder
from jointfit_drivers.ximu3._driver import XImu3Imu
from jointfit_drivers.ximu3._settings import XImu3Settings

__all__ = ["XImu3Decoder", "XImu3Imu", "XImu3Settings"]
