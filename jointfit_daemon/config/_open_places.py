"""Open places of a rig.toml: keys with the word ``later`` instead of a value.

`jointfit init` writes the word where a device, identifiers or names were not known yet.
Invariant: an open place is reported as one fault with its remedy, and causes no other fault.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from jointfit_daemon.config._fault_messages import Fault

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from jointfit_daemon.config._rig import Source

LATER = "later"
"""Word that replaces a device, identifiers or names that are not known yet."""
_FEW = 4
"""Number of placeholder markers in an open place. No check requires more markers."""
_AGAIN = "`jointfit init FOLDER --force` asks for the missing values only"
_PORT = (
    "not filled in yet: connect the sensor and enter its serial port, which `jointfit probe` lists;"
    f" or, for a sensor on a CAN bus, its driver, can and ids. {_AGAIN}"
)
_SERVER = (
    "not filled in yet: enter the address of the motion-capture computer, which `jointfit probe"
    f" --network` finds; or remove [mocap] to use IMUs only. {_AGAIN}"
)
_IDS = (
    "not filled in yet: enter the identifiers that the sensor sends, which `jointfit probe` lists"
    f" for a CAN interface. {_AGAIN}"
)
_MARKERS = (
    "not filled in yet: enter the names of the markers as in the stream, which `jointfit probe"
    f" --network` lists. {_AGAIN}"
)
_PLATE = (
    "not filled in yet: enter the name of the rigid body of the plate, or remove this key to"
    f" calibrate without the align phase. {_AGAIN}"
)


def fill_open_places(table: Mapping[str, Any]) -> tuple[dict[str, Any], list[Fault]]:
    """Return a copy of `table` with valid values in its open places, and a fault for each place."""
    filled, faults = dict(table), []

    imus = table.get("imu")
    if isinstance(imus, list):
        filled["imu"] = list(imus)
        for at, imu in enumerate(imus):
            if not isinstance(imu, dict):
                continue
            key = f"imu[{imu.get('id', at)}]"
            if imu.get("port") == LATER:
                filled["imu"][at] = imu | {"port": f"/dev/{LATER}-{at}"}
                faults.append(Fault(f"{key}.port", _PORT, LATER))
            if imu.get("ids") == LATER:
                # The driver's default identifiers may belong to another sensor; see
                # `with_known_ids`.
                filled["imu"][at] = {name: value for name, value in imu.items() if name != "ids"}
                faults.append(Fault(f"{key}.ids", _IDS, LATER))

    mocap = table.get("mocap")
    if isinstance(mocap, dict):
        filled["mocap"], open_keys = _filled_cameras(mocap)
        faults += open_keys
    return filled, faults


def _filled_cameras(mocap: Mapping[str, Any]) -> tuple[dict[str, Any], list[Fault]]:
    filled, faults = dict(mocap), []
    if mocap.get("server") == LATER:
        filled["server"] = "192.0.2.1"  # address reserved for documentation
        faults.append(Fault("mocap.server", _SERVER, LATER))
    if mocap.get("plate") == LATER:
        filled["plate"] = f"{LATER}-plate"
        faults.append(Fault("mocap.plate", _PLATE, LATER))

    markers = mocap.get("markers")
    if isinstance(markers, dict):
        filled["markers"] = dict(markers)
        for part, names in markers.items():
            if names == LATER:
                filled["markers"][part] = [f"{LATER}-{part}-{k}" for k in range(_FEW)]
                faults.append(Fault(f"mocap.markers.{part}", _MARKERS, LATER))
    return filled, faults


def with_known_ids(sources: Iterable[Source], faults: Iterable[Fault]) -> list[Source]:
    """Return the sensors whose identifiers are not open places."""
    open_keys = {fault.key for fault in faults if fault.value == LATER}
    return [source for source in sources if f"imu[{source.id}].ids" not in open_keys]
