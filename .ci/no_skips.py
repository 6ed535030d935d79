"""Fail when a test that CI must run was skipped: `no_skips.py JUNIT.xml`.

Only the tests of tests/vm may be skipped in that step: the next one runs them on a kernel that has
vcan, and fails if one is skipped there.
"""

import sys
from pathlib import Path
from xml.etree import ElementTree as ET

MAY_SKIP = "tests.vm."


def wrongly_skipped(report: Path) -> list[str]:
    """Return the tests that were skipped and must not be, each with its reason."""
    return [
        f"{name}: {found.get('message') or 'no reason given'}"
        for case in ET.parse(report).getroot().iter("testcase")  # noqa: S314 - pytest's, just made
        for found in case.iter("skipped")
        if found.get("type") != "pytest.xfail"
        and not (name := f"{case.get('classname')}::{case.get('name')}").startswith(MAY_SKIP)
    ]


def main(report: Path) -> int:
    """Tell what was skipped; 1 if anything was that must not be, or if nothing ran at all."""
    wrong = wrongly_skipped(report)
    for line in wrong:
        print(f"skipped, but CI must run it: {line}")
    ran = sum(1 for _ in ET.parse(report).getroot().iter("testcase"))  # noqa: S314 - as above
    print(f"{ran} tests, {len(wrong)} wrongly skipped")
    return 1 if wrong or not ran else 0


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1])))
