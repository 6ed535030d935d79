"""Conversion of rig.toml to a `Rig`.

Invariant: all faults are reported together, before any device is opened.
"""

from __future__ import annotations

import json
from contextlib import suppress
from copy import deepcopy
from dataclasses import replace
from typing import TYPE_CHECKING, Any, TypeVar

from pydantic import BaseModel, ValidationError

from jointfit_daemon.calibration import CalibrationSettings
from jointfit_daemon.config import _bandwidth, _checks
from jointfit_daemon.config._branched_limb import branched_limb
from jointfit_daemon.config._bus_faults import complete_bus, likely_interface, unusable_keys
from jointfit_daemon.config._fault_messages import ConfigError, Fault, faults_of
from jointfit_daemon.config._open_places import fill_open_places, with_known_ids
from jointfit_daemon.config._readable import contradictions, readable_part
from jointfit_daemon.config._rig import MOCAP, Rig, Source
from jointfit_daemon.config._syntax import read_table, without_unreadable
from jointfit_daemon.config._tables import (
    CalibrationTable,
    ChainTable,
    LslSettings,
    MetricsSettings,
    MqttSettings,
    RecordingSettings,
    RigTable,
)
from jointfit_daemon.driver import (
    CanBusSettings,
    ImuSettings,
    MocapSettings,
    UnknownDriverError,
    driver_names,
    find_driver,
)
from jointfit_daemon.files.text import find_structure_fault
from jointfit_daemon.model import Chain
from jointfit_daemon.nearest_name import nearest_name

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    from jointfit_daemon.calibration import ChainRefinement
    from jointfit_daemon.driver import Driver
    from jointfit_daemon.files.models import LoadedModel

Model = TypeVar("Model", bound=BaseModel)

SECTIONS = (
    "rig", "chain", "imu", "can", "mocap", "calibration", "mqtt", "recording", "metrics", "lsl",
)  # fmt: skip


def load_rig(path: Path) -> Rig:
    """Read and check the rig.toml at `path`.

    File names in ``[mqtt]``, ``[chain]``, ``[[imu]]`` and ``[calibration.chain_refinement]`` are
    relative to the folder of `path`.

    Raises
    ------
    ConfigError
        The file cannot be read, is not TOML, or is invalid; the message lists all faults.
    """
    table, syntax = read_table(path)
    mqtt, folder = table.get("mqtt"), path.absolute().parent
    _anchor(table.get("chain"), ("model",), folder)
    _anchor(table.get("imu"), ("dbc",), folder)
    calibration = table.get("calibration")
    if isinstance(calibration, dict):
        _anchor(calibration.get("chain_refinement"), ("weights",), folder)
    if isinstance(mqtt, dict):
        _anchor(mqtt, ("password_file", "request_key_file"), folder)
        _anchor(mqtt.get("tls"), ("ca", "cert", "key"), folder)
    return _rig_of(table, str(path), syntax)


def parse_rig(table: Mapping[str, Any], *, source: str = "rig.toml") -> Rig:
    """Check `table`, a parsed rig.toml, and return the rig.

    Parameters
    ----------
    table
        Result of tomllib; it is copied.
    source
        Name of the file, for messages.

    Raises
    ------
    ConfigError
        The table is invalid; the message lists all faults.
    """
    if (fault := find_structure_fault(table)) is not None:
        raise ConfigError(source, [Fault("TOML", fault)])
    return _rig_of(deepcopy(dict(table)), source, [])


def _rig_of(table: dict[str, Any], source: str, syntax: Sequence[Fault]) -> Rig:
    unusable = list(_checks.check_control_characters(table))
    reader = _RigReader(_checks.without_control_characters(table) if unusable else table)
    rig = reader.rig()
    others = list(filter(None, map(without_unreadable, reader.faults))) if syntax else reader.faults
    faults = [*syntax, *unusable, *others]
    if rig is None or faults:
        raise ConfigError(source, list({fault.text(): fault for fault in faults}.values()))
    return rig


def _anchor(part: object, keys: Sequence[str], folder: Path) -> None:
    """Make the file names of a table, or of an array of tables, absolute."""
    tables: list[Any] = part if isinstance(part, list) else [part]
    for table in tables:
        for key in keys if isinstance(table, dict) else ():
            if isinstance(table.get(key), str):
                table[key] = str(folder / table[key])


class _RigReader:
    """Reads one rig.toml and collects its faults."""

    def __init__(self, table: dict[str, Any]) -> None:
        self.table, self.faults = fill_open_places(table)
        self.partial: dict[str, Any] = {}
        """Partial models of the tables with faults, by key, for checks across tables."""
        self.cameras: MocapSettings | None = None
        """The ``[mocap]`` table, even if it has faults."""
        self.imus_read: list[Source] = []
        """All IMUs whose tables are readable, even if the tables have faults."""
        self.imus_with_load: list[Source] = []
        """IMUs of `imus_read` with known load. Faulty keys have the values with the least load."""
        for key in table:
            if key not in SECTIONS:
                known = f"unknown table; known: {', '.join(SECTIONS)}"
                self.faults.append(Fault(key, known, near=nearest_name(key, SECTIONS)))

    def rig(self) -> Rig | None:
        """Return the rig if there is no fault.

        Otherwise collect the faults of all tables and return None.
        """
        head = self._section("rig", RigTable, needed=True)
        chain = self._section("chain", ChainTable, needed=True)
        calibration = self._section("calibration", CalibrationTable)
        mqtt = self._section("mqtt", MqttSettings)
        recording = self._optional_section("recording", RecordingSettings)
        metrics = self._optional_section("metrics", MetricsSettings)
        lsl = self._optional_section("lsl", LslSettings)

        buses = self._buses()
        limb = chain or self.partial.get("chain")
        sources = self._imus(limb, buses)
        mocap = self._mocap(limb, head)

        # Values are compared across tables, even if some tables have faults.
        self.faults += _checks.check_ports(self.imus_read, buses)
        self.faults += _checks.check_can_ids(with_known_ids(self.imus_read, self.faults))
        # A load computed from a faulty key is meaningless.
        reported = {fault.key for fault in self.faults}
        loads = [
            *_bandwidth.check_serial_lines(self.imus_with_load),
            *_bandwidth.check_can_buses(self.imus_with_load, buses),
        ]
        self.faults += [fault for fault in loads if fault.key not in reported]
        self.faults += self._names()
        cameras = self.cameras
        self._check_limb(chain, calibration, cameras)
        model = None if limb is None else self._chain_model(limb, cameras)
        refinement = self._chain_refinement(calibration, model)
        if head is None or chain is None or calibration is None or mqtt is None or self.faults:
            return None

        base = mqtt.base or f"jointfit/{head.name}"
        return Rig(
            name=head.name,
            output_rate_hz=head.output_rate_hz,
            align_mode=head.align_mode,
            chain=_chain(chain, sources),
            chain_model=model,
            sources=(*sources, mocap) if mocap is not None else tuple(sources),
            calibration=CalibrationSettings(
                **calibration.model_dump(exclude={"store", "center_target_mm", "chain_refinement"}),
                center_target_m=calibration.center_target_mm / 1e3,
                chain_refinement=refinement,
                markers={} if mocap is None else dict(mocap.settings.markers),
                rigid_bodies={} if mocap is None else dict(mocap.settings.rigid_body),
                plate=None if mocap is None else mocap.settings.plate,
            ),
            calibration_store=calibration.store,
            mqtt=mqtt.model_copy(update={"base": base}),
            recording=recording,
            metrics=metrics,
            lsl=lsl,
            table=self.table,
        )

    def _check_limb(
        self,
        chain: ChainTable | None,
        calibration: CalibrationTable | None,
        cameras: MocapSettings | None,
    ) -> None:
        """Check the limb and its calibration; partial models replace the tables with faults."""
        limb = chain or self.partial.get("chain")
        if limb is not None:
            self.faults += _checks.check_chain(limb)
            if cameras is not None or "mocap" not in self.table:
                self.faults += _checks.check_planar(limb, cameras, self.table.get("imu"))
        table = calibration or self.partial.get("calibration")
        self.faults += _checks.check_procedure(table, limb)
        if table is not None:
            self.faults += _checks.check_durations(table)
        if table is not None and (cameras is not None or "mocap" not in self.table):
            self.faults += _checks.check_center_methods(table, limb, cameras)

    def _chain_model(self, chain: ChainTable, cameras: MocapSettings | None) -> LoadedModel | None:
        """Return the chain model, and replace its file name in the table by the file's content.

        A recording of the table then contains everything that a replay needs.
        """
        if chain.model is None:
            return None
        from jointfit_daemon.config._chain_model import (  # noqa: PLC0415 - it loads scipy
            content_of,
            load_chain_model,
        )

        model, faults = load_chain_model(chain.model, chain, cameras)
        self.faults += faults
        if model is not None and not faults:
            self.table["chain"]["model"] = content_of(model)
        return model

    def _chain_refinement(
        self, calibration: CalibrationTable | None, model: LoadedModel | None
    ) -> ChainRefinement | None:
        """Return the refinement of the chain model; None without a model or if a key is faulty.

        If the table contains the name of a weight file, the content of the file replaces the name.
        """
        table = calibration or self.partial.get("calibration")
        key, name = "calibration.chain_refinement", "chain_refinement"
        section = self.table.get("calibration")
        given = section.get(name) if isinstance(section, dict) else None
        if model is None:
            has_model = isinstance(chain := self.table.get("chain"), dict) and "model" in chain
            if given is not None and not has_model:
                text = "needs a chain model: add [chain] model, or remove this table"
                self.faults.append(Fault(key, text))
            return None
        if table is None or table.chain_refinement is None:
            return None
        from jointfit_daemon.config._chain_model import load_refinement  # noqa: PLC0415 - as above

        refinement, weights, faults = load_refinement(model.chain, table.chain_refinement)
        reported = {fault.key for fault in self.faults}
        self.faults += [fault for fault in faults if fault.key not in reported]
        if given and not faults:
            given["weights"] = weights
        return refinement

    def _names(self) -> list[Fault]:
        """Check the names of topics and folders, even if other keys of the same table are wrong."""
        faults: list[Fault] = []
        for section, key, check in (
            ("rig", "name", _checks.check_topic_name),
            ("calibration", "store", _checks.check_folder_name),
            ("mqtt", "base", _checks.check_topic_base),
        ):
            table = self.table.get(section)
            name = table.get(key) if isinstance(table, dict) else None
            if isinstance(name, str) and (name or key != "base"):
                faults += check(f"{section}.{key}", name)
        return faults

    def _section(self, key: str, model: type[Model], *, needed: bool = False) -> Model | None:
        if key not in self.table and needed:
            self.faults.append(Fault(f"[{key}]", "this table is missing"))
            return None
        return self._validate(key, self.table.get(key, {}), model)

    def _optional_section(self, key: str, model: type[Model]) -> Model | None:
        """Return a table of rig.toml; None if the table is absent or has faults."""
        return self._section(key, model) if key in self.table else None

    def _validate(self, key: str, table: object, model: type[Model]) -> Model | None:
        if not isinstance(table, dict):
            self.faults.append(Fault(key, "expected a table", table))
            return None
        try:  # strict JSON mode accepts arrays as tuples, but no strings as numbers
            return model.model_validate_json(json.dumps(table, default=str), strict=True)
        except ValidationError as error:
            self.faults += faults_of(error, model, key)
            wrong = [detail["loc"] for detail in error.errors()]
            self.partial[key] = readable_part(table, model, wrong)
            self.faults += contradictions(self.partial[key], key)
            return None

    def _buses(self) -> dict[str, CanBusSettings]:
        tables = self.table.get("can", {})
        if not isinstance(tables, dict):
            self.faults.append(Fault("can", "expected tables [can.NAME]", tables))
            return {}
        imus = self.table.get("imu")
        tables_of_imus = imus if isinstance(imus, list) else []
        named = [imu.get("driver") for imu in tables_of_imus if isinstance(imu, dict)]
        in_use = [name for name in named if isinstance(name, str)]

        buses = {}
        for at, name in enumerate(tables):
            key, table = f"can.{name}", tables[name]
            kind = table.get("interface", "socketcan") if isinstance(table, dict) else 0
            if isinstance(kind, str):
                table = self._check_bus_keys(key, table, in_use)

            bus = self._validate(key, table, CanBusSettings)
            partial = self.partial.get(key)
            if bus is None and partial is not None:
                bus = complete_bus(partial, f"unknown{at}")
            if bus is not None:
                buses[name] = bus
        return buses

    def _check_bus_keys(
        self, key: str, table: dict[str, Any], in_use: Sequence[str]
    ) -> dict[str, Any]:
        """Report keys that the CAN interface rejects; return the table with a valid interface."""
        unusable = unusable_keys(table, in_use)
        usable = table
        if "interface" in unusable:
            usable = table | {"interface": likely_interface(table["interface"])}
            if usable["interface"] != "virtual":
                unusable = unusable_keys(usable, in_use) | unusable
        for name, text in unusable.items():
            shown = (table[name],) if name in table else ()
            self.faults.append(Fault(f"{key}.{name}", text, *shown))
        return usable

    def _imus(self, chain: ChainTable | None, buses: Mapping[str, CanBusSettings]) -> list[Source]:
        tables = self._imu_tables()

        self.faults += _checks.check_sensors(tables, chain)
        found = []
        for at, imu in enumerate(tables, 1):
            key = f"imu[{_checks.imu_name(imu, at)}]"
            driver = self._driver(key, imu, ImuSettings)
            has_bus = driver is None or "can" in driver.Settings.model_fields
            table = self._with_bus(key, imu, buses) if has_bus else imu
            settings = self._settings(key, table, driver, ImuSettings)
            if driver is not None and settings is not None:
                found.append(_imu_source(imu["driver"], settings, driver))

            known = settings or self.partial.get(key)
            if driver is not None and known is not None:
                if known.id is None:
                    known = known.model_copy(update={"id": _checks.imu_name(imu, at)})
                source = _imu_source(str(imu.get("driver")), known, driver)
                self.imus_read.append(source)
                unknown = imu.keys() - driver.Settings.model_fields.keys()
                if (least := _bandwidth.least_load(known, unknown)) is not None:
                    self.imus_with_load.append(replace(source, settings=least))
        return found

    def _imu_tables(self) -> list[dict[str, Any]]:
        """Return the readable tables of sensors, and report the unreadable tables."""
        found = self.table.get("imu", [])
        if not isinstance(found, list) or not all(isinstance(imu, dict) for imu in found):
            single = "; write [[imu]] in place of [imu]" if isinstance(found, dict) else ""
            shown = () if single and found else (found,)
            self.faults.append(Fault("imu", f"expected [[imu]] tables{single}", *shown))
        if isinstance(found, dict):
            return [found] if found else []
        return [imu for imu in found if isinstance(imu, dict)] if isinstance(found, list) else []

    def _with_bus(
        self, key: str, imu: dict[str, Any], buses: Mapping[str, CanBusSettings]
    ) -> dict[str, Any]:
        """Return a sensor's table with the ``[can.NAME]`` table instead of the name of the bus."""
        if "can" not in imu:
            return imu
        name = imu["can"]
        if isinstance(name, str) and name in buses:
            return imu | {"can": buses[name].model_dump()}

        named = self.table.get("can", {})
        if not isinstance(name, str):
            text = "expected the name of a [can.NAME] table"
            self.faults.append(Fault(f"{key}.can", text, name))
        elif isinstance(named, dict) and name not in named:
            text = f"no table [can.{name}]; known: {', '.join(named) or 'none'}"
            self.faults.append(Fault(f"{key}.can", text, name, nearest_name(name, named)))
        # The unknown bus is already reported. The sensor gets a virtual bus, so that its other keys
        # can be checked.
        bus = CanBusSettings(interface="virtual", channel=f"unknown {name}")
        return imu | {"can": bus.model_dump()}

    def _driver(
        self, key: str, table: dict[str, Any], base: type[BaseModel]
    ) -> type[Driver] | None:
        name = table.get("driver")
        if not isinstance(name, str):  # the model of the settings reports the fault
            return _likely_driver(None, table, base)

        try:
            driver = find_driver(name)
        except UnknownDriverError:
            named = _checks.check_known_name(f"{key}.driver", name, _drivers(base), "driver")
            self.faults += named
            return _likely_driver(named[0].near, table, base)
        except Exception as error:  # noqa: BLE001 - a broken plug-in is a fault of the rig
            text = f"cannot be loaded ({error!r}): install it again, or report it to its author"
            self.faults.append(Fault(f"{key}.driver", text, name))
            return None

        if not issubclass(driver.Settings, base):
            what = "motion capture" if base is ImuSettings else "an IMU"
            text = f"is a driver for {what}; known here: {', '.join(_drivers(base)) or 'none'}"
            self.faults.append(Fault(f"{key}.driver", text, name))
            return _likely_driver(None, table, base)
        return driver

    def _settings(
        self, key: str, table: object, driver: type[Driver] | None, base: type[BaseModel]
    ) -> Any:
        """Validate a table with its driver's model, or with `base` if the driver is unknown."""
        if driver is not None:
            try:
                return self._validate(key, table, driver.Settings)
            except Exception as error:  # noqa: BLE001 - a broken plug-in is a fault of the rig
                text = f"its check of this table failed ({error!r}): report it to its author"
                self.faults.append(Fault(f"{key}.driver", text))
                return None
        if isinstance(table, dict):
            table = {name: value for name, value in table.items() if name in base.model_fields}
        return self._validate(key, table, base)

    def _mocap(self, chain: ChainTable | None, head: RigTable | None) -> Source | None:
        table = self.table.get("mocap")
        if table is None:
            return None
        driver = self._driver(MOCAP, table, MocapSettings) if isinstance(table, dict) else None
        settings = self._settings(MOCAP, table, driver, MocapSettings)
        known = settings or self.partial.get(MOCAP)
        self.cameras = known
        if known is not None:
            self.faults += _checks.check_markers(known, chain)
        if settings is None or driver is None or head is None:
            return None
        rate = getattr(settings, "rate_hz", None) or head.output_rate_hz
        return Source(MOCAP, "mocap", table["driver"], rate, None, settings, driver)


def _likely_driver(
    near: str | None, table: Mapping[str, Any], base: type[BaseModel]
) -> type[Driver] | None:
    """Return the driver that the table probably means, so that its other keys can be checked.

    The first choice is the driver `near`, whose name is similar to the misspelled name. The second
    choice is the driver that accepts the largest number of keys that are not common to all drivers.
    """
    drivers = _drivers(base)
    if near in drivers:
        return drivers[near]

    special = table.keys() - base.model_fields.keys()
    known = {name: len(special & drivers[name].Settings.model_fields.keys()) for name in drivers}
    most = [name for name in known if known[name] == max(known.values())]
    if len(most) != 1:
        return None
    # A name that resembles no known driver may be a driver that is not installed.
    return drivers[most[0]] if known[most[0]] or "driver" not in table else None


def _drivers(base: type[BaseModel]) -> dict[str, type[Driver]]:
    """Return the loadable drivers by name whose settings derive from `base`."""
    found = {}
    for name in driver_names():
        # A broken plug-in must affect only the rigs that use it.
        with suppress(Exception):
            driver = find_driver(name)
            if issubclass(driver.Settings, base):
                found[name] = driver
    return found


def _imu_source(name: str, settings: Any, driver: type[Driver]) -> Source:
    return Source(settings.id, "imu", name, settings.rate_hz, settings.segment, settings, driver)


def _chain(table: ChainTable, sources: Sequence[Source]) -> Chain:
    branched = branched_limb(table) if table.joint else None
    joints, segments = (table.joints, table.segments) if branched is None else branched[:2]
    return Chain(
        joints=joints,
        segments=segments,
        sensors=tuple(
            tuple(source.id for source in sources if source.segment == segment)
            for segment in segments
        ),
        left_side=table.side == "left",
        origin=table.origin_m,
        lengths=tuple(table.lengths_m.get(segment) for segment in segments),
        proximal=table.proximal,
        distal=table.distal,
        static_axes=table.axes == "static",
        planar=table.motion == "planar",
        conventions=tuple(table.angles.get(joint) for joint in joints),
        parents=() if branched is None else branched.parents,
        left_joints=() if branched is None else branched.left,
        distals=() if branched is None else branched.distals,
    )
