"""Driver for IMUs on a CAN bus whose frames are described in rig.toml or by a DBC file."""

from jointfit_drivers.can_table._decoder import CanTableDecoder
from jointfit_drivers.can_table._driver import CanTableImu
from jointfit_drivers.can_table._settings import CanTableSettings

__all__ = ["CanTableDecoder", "CanTableImu", "CanTableSettings"]
