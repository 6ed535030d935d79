"""Deletion of the oldest recordings of a rig."""

from __future__ import annotations

from typing import TYPE_CHECKING

from jointfit_daemon.outputs.recording._channels import recorded_rig_name

if TYPE_CHECKING:
    from pathlib import Path


def delete_oldest(directory: Path, rig: str, keep_bytes: float) -> list[Path]:
    """Delete the oldest complete files of `rig` until its remaining files fit into `keep_bytes`.

    Parameters
    ----------
    directory
        Folder of the recordings.
    rig
        Beginning of the file names. Files of other rigs are not deleted.
    keep_bytes
        Largest total size of the files, including the open file, bytes.

    Returns
    -------
    list of Path
        The deleted files.

    Raises
    ------
    OSError
        A file cannot be deleted.
    """
    sizes = {
        path: path.stat().st_size
        for path in directory.iterdir()
        if recorded_rig_name(path.name) == rig
    }
    used, deleted = sum(sizes.values()), []
    for path in sorted(sizes):
        if used <= keep_bytes:
            break
        if path.suffix == ".mcap":
            path.unlink()
            used -= sizes[path]
            deleted.append(path)
    return deleted
