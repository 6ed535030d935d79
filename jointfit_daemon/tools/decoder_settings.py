"""Settings of a driver that only decodes: keys of the connection get placeholders."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, get_args

from pydantic import BaseModel, ValidationError

from jointfit_daemon.config import faults_of

if TYPE_CHECKING:
    from collections.abc import Mapping

    from jointfit_daemon.driver import Driver


def decoder_settings(driver: type[Driver], name: str, given: Mapping[str, Any]) -> Any:
    """Return the settings of `driver` with the keys in `given`.

    Raises
    ------
    ValueError
        A value in `given` is invalid; the message names the keys.
    """
    table: dict[str, Any] = {"driver": name, **given}
    for key, info in driver.Settings.model_fields.items():
        if info.is_required() and key not in table:
            kinds = [info.annotation, *get_args(info.annotation)]
            if any(isinstance(kind, type) and issubclass(kind, BaseModel) for kind in kinds):
                table[key] = {"interface": "virtual", "channel": "file"}
            else:
                table[key] = "file" if str in kinds else 1
    try:
        return driver.Settings.model_validate(table)
    except ValidationError as error:
        faults = faults_of(error, driver.Settings, name)
        raise ValueError("; ".join(fault.text() for fault in faults)) from None
