"""JSON schema of rig.toml, including the tables of drivers, generated from the models."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from pydantic.json_schema import models_json_schema

from jointfit_daemon.config._tables import (
    CalibrationTable,
    ChainTable,
    LslSettings,
    MetricsSettings,
    MqttSettings,
    RecordingSettings,
    RigTable,
)
from jointfit_daemon.driver import CanBusSettings, ImuSettings, driver_names, find_driver

if TYPE_CHECKING:
    from pydantic import BaseModel

_SECTIONS: dict[str, type[BaseModel]] = {
    "rig": RigTable,
    "chain": ChainTable,
    "calibration": CalibrationTable,
    "mqtt": MqttSettings,
    "recording": RecordingSettings,
    "metrics": MetricsSettings,
    "lsl": LslSettings,
}


def rig_schema() -> dict[str, Any]:
    """Return the JSON schema (2020-12) of rig.toml; it omits drivers that cannot be loaded."""
    drivers: dict[str, type[BaseModel]] = {}
    for name in driver_names():
        try:
            drivers[name] = find_driver(name).Settings
        except Exception:  # noqa: BLE001, S112 - a broken plug-in must not hide the others
            continue

    # Adapt the definitions of all models to the file.
    models: list[type[BaseModel]] = [*_SECTIONS.values(), CanBusSettings, *drivers.values()]
    refs, definitions = models_json_schema(
        [(model, "validation") for model in models], ref_template="#/$defs/{model}"
    )
    defs = definitions["$defs"]
    at = {model: refs[model, "validation"] for model in models}
    for name, model in drivers.items():
        properties = defs[at[model]["$ref"].rpartition("/")[2]]["properties"]
        properties["driver"] = {"const": name, "description": "driver name"}
        if "can" in properties:  # the file contains a name, the driver gets a table
            properties["can"] = {"type": "string", "description": "name of a [can.NAME] table"}

    imus = [at[model] for model in drivers.values() if issubclass(model, ImuSettings)]
    mocaps = [at[model] for model in drivers.values() if not issubclass(model, ImuSettings)]
    properties = {name: at[model] for name, model in _SECTIONS.items()}
    properties["imu"] = {"type": "array", "minItems": 1, "items": {"anyOf": imus}}
    properties["can"] = {"type": "object", "additionalProperties": at[CanBusSettings]}
    properties["mocap"] = {"anyOf": mocaps}
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": "rig.toml of jointfitd",
        "type": "object",
        "properties": properties,
        "required": ["rig", "chain"],
        "anyOf": [{"required": ["imu"]}, {"required": ["mocap"]}],  # planar rigs have no IMU
        "additionalProperties": False,
        "$defs": defs,
    }
