"""Common parts of motion-capture drivers: names of columns, poses, continuity, network route."""

from jointfit_drivers.motion_capture._binding import (
    MOST_NAMED,
    ColumnBinding,
    ColumnKey,
    ModelEntry,
    bind_columns,
    renew_columns,
    wanted_names,
)
from jointfit_drivers.motion_capture._continuity import FrameContinuity, FrameStep
from jointfit_drivers.motion_capture._reception import (
    CHECK,
    Reception,
    content_findings,
    run_until,
    summary,
    tracking_findings,
)
from jointfit_drivers.motion_capture._route import Route, find_route, host_address
from jointfit_drivers.motion_capture._server_output import ServerOutput
from jointfit_drivers.motion_capture._server_search import gather_servers
from jointfit_drivers.motion_capture._settings import ServerSettings
from jointfit_drivers.motion_capture._socket_link import SocketLink
from jointfit_drivers.motion_capture._tcp_link import TcpLink
from jointfit_drivers.motion_capture._unit_check import UnitCheck
from jointfit_drivers.motion_capture._world import (
    ABSENT,
    FARTHEST_M,
    NO_POSITION,
    UpAxis,
    is_near,
    matrix_quaternion,
    rows_array,
    unit_quaternion,
    world_rotation,
)

__all__ = [
    "ABSENT",
    "CHECK",
    "FARTHEST_M",
    "MOST_NAMED",
    "NO_POSITION",
    "ColumnBinding",
    "ColumnKey",
    "FrameContinuity",
    "FrameStep",
    "ModelEntry",
    "Reception",
    "Route",
    "ServerOutput",
    "ServerSettings",
    "SocketLink",
    "TcpLink",
    "UnitCheck",
    "UpAxis",
    "bind_columns",
    "content_findings",
    "find_route",
    "gather_servers",
    "host_address",
    "is_near",
    "matrix_quaternion",
    "renew_columns",
    "rows_array",
    "run_until",
    "summary",
    "tracking_findings",
    "unit_quaternion",
    "wanted_names",
    "world_rotation",
]
