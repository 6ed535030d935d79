"""Open places of a rig.toml: keys with the word ``later`` instead of a device.

`jointfit init` writes them where no device was connected yet. Invariant: an open place is one fault
with its remedy, and causes no other fault.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from jointfit_daemon.config._fault_messages import Fault

if TYPE_CHECKING:
    from collections.abc import Mapping

LATER = "later"
"""Word in place of a device that is not known yet."""
_AGAIN = "`jointfit init FOLDER --force` asks for the open places only"
_PORT = (
    "not filled in yet: connect the sensor and enter its serial port, which `jointfit probe` lists;"
    f" or, for a sensor on a CAN bus, its driver, can and ids. {_AGAIN}"
)
_SERVER = (
    "not filled in yet: enter the address of the motion-capture computer, which `jointfit probe"
    f" --network` finds; or remove [mocap] to use IMUs only. {_AGAIN}"
)


def fill_open_places(table: Mapping[str, Any]) -> tuple[dict[str, Any], list[Fault]]:
    """Return a copy of a rig with valid values in its open places, and the fault of each place."""
    filled, faults = dict(table), []

    imus = table.get("imu")
    if isinstance(imus, list):
        filled["imu"] = list(imus)
        for at, imu in enumerate(imus):
            if isinstance(imu, dict) and imu.get("port") == LATER:
                filled["imu"][at] = imu | {"port": f"/dev/{LATER}-{at}"}
                faults.append(Fault(f"imu[{imu.get('id', at)}].port", _PORT, LATER))

    mocap = table.get("mocap")
    if isinstance(mocap, dict) and mocap.get("server") == LATER:
        filled["mocap"] = mocap | {"server": "192.0.2.1"}  # an address for documentation
        faults.append(Fault("mocap.server", _SERVER, LATER))
    return filled, faults
