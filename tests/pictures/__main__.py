"""Makes the generated pictures of the documentation. `make pictures` takes four minutes."""

from __future__ import annotations

import tempfile
from pathlib import Path

from tests.pictures import drift_event
from tests.pictures.dashboard_pages import draw_pages
from tests.pictures.report_page import draw_report
from tests.pictures.tutorial_run import run_tutorial

PICTURES = Path(__file__).resolve().parents[2] / "docs" / "pictures"


def main() -> None:
    """Write all pictures."""
    draw_pages(PICTURES)
    with tempfile.TemporaryDirectory(prefix="jointfit-pictures-") as folder:
        run_tutorial(Path(folder), PICTURES)
        draw_report(Path(folder), PICTURES / "report.webp")
    drift = drift_event.draw(drift_event.run())
    (PICTURES / "drift-event.svg").write_text(drift, encoding="utf-8")


if __name__ == "__main__":
    main()
