"""Marker weights and time range of an OpenSim set-up file for inverse kinematics."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from jointfit_daemon.files.models._osim_document import numbers_of, read_xml, text_of
from jointfit_daemon.files.text import MalformedFileError

if TYPE_CHECKING:
    from pathlib import Path
    from xml.etree.ElementTree import Element


@dataclass(frozen=True, slots=True)
class IkSetup:
    """Part of a set-up file that inverse kinematics uses."""

    weights: dict[str, float]
    """Weight of each marker task; 0 for tasks that are not applied."""
    time_range: tuple[float, float] | None
    """First and last time of the trial to evaluate, s; None if the file contains no range."""
    ignored: tuple[str, ...]
    """Names of the coordinate tasks that the file applies, but `jointfit` ignores."""


def read_ik_setup(path: Path) -> IkSetup:
    """Return the tasks of an ``InverseKinematicsTool`` file, or of an ``IKTaskSet``.

    Raises
    ------
    MalformedFileError
        The file is not XML, has no marker task, or has a weight that is not a number of at least 0.
    """
    root = read_xml(path)
    ignored = [task.get("name", "") for task in root.iter("IKCoordinateTask") if _is_applied(task)]
    try:
        weights = {task.get("name", ""): _weight(task) for task in root.iter("IKMarkerTask")}
        spans = [
            numbers_of(tool, "time_range", 2).tolist()
            for tool in root.iter("InverseKinematicsTool")
            if text_of(tool, "time_range")
        ]
    except ValueError as error:
        raise MalformedFileError(f"{path}: {error}") from error

    if not weights:
        raise MalformedFileError(
            f"{path}: no IKMarkerTask found, expected an OpenSim set-up file for inverse"
            " kinematics: choose the file of the IK tool"
        )
    return IkSetup(weights, (spans[0][0], spans[0][1]) if spans else None, tuple(ignored))


def _is_applied(task: Element) -> bool:
    return text_of(task, "apply", "true").lower() == "true"


def _weight(task: Element) -> float:
    """Return the weight of a task; 0 if the task is not applied."""
    weight = float(numbers_of(task, "weight", 1)[0])
    if weight < 0.0:
        raise ValueError(f"{task.get('name')}: weight is {weight:g}, expected 0 or more")
    return weight if _is_applied(task) else 0.0
