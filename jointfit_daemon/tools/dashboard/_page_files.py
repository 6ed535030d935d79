"""Files of the web page, which are read and compressed once.

Invariant: a request selects a file by its exact name, so no request can read a file outside the
page folder.
"""

from __future__ import annotations

import gzip
import hashlib
from dataclasses import dataclass
from pathlib import Path

PAGE = Path(__file__).with_name("page")
_TYPES = {
    ".html": "text/html; charset=utf-8",
    ".css": "text/css; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
    ".svg": "image/svg+xml",
    ".webmanifest": "application/manifest+json",
    ".json": "application/json",
    ".txt": "text/plain; charset=utf-8",
}


@dataclass(frozen=True, slots=True)
class PageFile:
    """One file of the web page."""

    content_type: str
    etag: str
    compressed: bytes
    """Content of the file, compressed with gzip."""

    @property
    def content(self) -> bytes:
        """Return the uncompressed content, for the few clients that do not accept gzip."""
        return gzip.decompress(self.compressed)


def read_page_files(folder: Path = PAGE) -> dict[str, PageFile]:
    """Return the files below `folder`, by URL path; the path ``/`` is ``index.html``."""
    files = {}
    for path in sorted(folder.rglob("*")):
        if path.suffix not in _TYPES:
            continue
        content = path.read_bytes()
        digest = hashlib.sha256(content).hexdigest()[:20]
        # The ETag is weak, because compressed and plain content have the same ETag.
        files[f"/{path.relative_to(folder).as_posix()}"] = PageFile(
            _TYPES[path.suffix], f'W/"{digest}"', gzip.compress(content, 9, mtime=0)
        )
    if "/index.html" in files:
        files["/"] = files["/index.html"]
    return files
