"""Driver settings for decoding without a device; the connection keys have placeholder values."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Literal, get_args, get_origin

from pydantic import BaseModel, ValidationError

from jointfit_daemon.config import faults_of
from jointfit_daemon.driver import CONTRADICTION, CanBusSettings

if TYPE_CHECKING:
    from collections.abc import Mapping

    from jointfit_daemon.driver import Driver


def decoder_settings(driver: type[Driver], name: str, given: Mapping[str, Any]) -> Any:
    """Return the settings of `driver` with the keys in `given`.

    Raises
    ------
    ValueError
        A value in `given` is invalid. The message names the key.
    """
    table: dict[str, Any] = {"driver": name, **given}
    for key, info in driver.Settings.model_fields.items():
        if info.is_required() and key not in table:
            kinds = [info.annotation, *get_args(info.annotation)]
            models = [k for k in kinds if isinstance(k, type) and issubclass(k, BaseModel)]
            if CanBusSettings in models:
                table[key] = {"interface": "virtual", "channel": "file"}
            elif get_origin(info.annotation) is Literal and 1 not in get_args(info.annotation):
                continue  # without a placeholder, the validation reports the missing key
            elif not models and get_origin(info.annotation) is not dict:
                # The value is a text or a number. For a table, there is no placeholder.
                table[key] = "file" if str in kinds else 1
    try:
        return driver.Settings.model_validate(table)
    except ValidationError as error:
        faults = faults_of(error, driver.Settings, name)
        texts = [fault.text() for fault in faults]
        texts += [
            f"{name}.{detail['msg']}"
            for detail in error.errors()
            if detail["type"] == CONTRADICTION
        ]
        raise ValueError("; ".join(texts) or str(error)) from None
