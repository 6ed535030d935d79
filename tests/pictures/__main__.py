"""Makes the generated pictures of the documentation: `make pictures`."""

from __future__ import annotations

from pathlib import Path

from tests.pictures import drift_event

PICTURES = Path(__file__).resolve().parents[2] / "docs" / "pictures"


def main() -> None:
    """Write all pictures."""
    drift = drift_event.draw(drift_event.run())
    (PICTURES / "drift-event.svg").write_text(drift, encoding="utf-8")


if __name__ == "__main__":
    main()
