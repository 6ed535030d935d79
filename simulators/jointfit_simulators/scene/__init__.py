"""Real-time scene of a subject, its devices, their streams, and the ground truth."""

from jointfit_simulators.scene._imu_families import ids_toml
from jointfit_simulators.scene._phase_follower import PhaseFollower
from jointfit_simulators.scene._play_directory import play_directory
from jointfit_simulators.scene._rig_file import RigOptions, rig_toml
from jointfit_simulators.scene._scene import InvalidCommandError, Scene, SceneOptions

__all__ = [
    "InvalidCommandError",
    "PhaseFollower",
    "RigOptions",
    "Scene",
    "SceneOptions",
    "ids_toml",
    "play_directory",
    "rig_toml",
]
