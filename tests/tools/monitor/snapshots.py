"""Stored pictures of the screen of `jointfit monitor`, as SVG.

With ``JOINTFIT_UPDATE_SNAPSHOTS=1`` the tests replace the stored pictures; check the new pictures,
and commit them with the change. pytest-textual-snapshot has the same purpose, but needs an older
pytest.
"""

from __future__ import annotations

import os
import re
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from jointfit_daemon.tools.monitor._app import MonitorApp

ROOT = Path(__file__).resolve().parents[3]
STORED = Path(__file__).with_name("snapshots")
NEW = ROOT / "build" / "monitor"
"""Folder of the new pictures that differ from the stored pictures."""
UPDATE = "JOINTFIT_UPDATE_SNAPSHOTS"
_FONT = re.compile(r"@font-face \{.*?\}\s*", re.DOTALL)
_ID = re.compile(r"terminal-\d+")


def picture_of(app: MonitorApp) -> str:
    """Return the screen as SVG, without fonts from the internet and with a fixed identifier."""
    return _ID.sub("terminal", _FONT.sub("", app.export_screenshot(title="jointfit monitor")))


def check_picture(app: MonitorApp, path: Path) -> None:
    """Compare the screen with a stored picture, or store it."""
    picture = picture_of(app)
    if os.environ.get(UPDATE):
        path.parent.mkdir(exist_ok=True)
        path.write_text(picture, encoding="utf-8")
    stored = path.read_text(encoding="utf-8") if path.exists() else None
    if picture != stored:
        NEW.mkdir(parents=True, exist_ok=True)
        (NEW / path.name).write_text(picture, encoding="utf-8")
    assert picture == stored, (
        f"{path} differs from {NEW / path.name}: look at both; if the new one is right, run the"
        f" tests with {UPDATE}=1"
    )
