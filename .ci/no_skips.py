"""Fail when a test that CI must run was skipped.

The only tests that may be skipped in this step are those marked `vm`: the next step runs them in
a virtual machine, and fails there if one is skipped.
"""

import sys
from pathlib import Path
from xml.etree import ElementTree as ET

MAY_SKIP = "tests.vm."


def main(report: Path) -> int:
    cases = list(ET.parse(report).getroot().iter("testcase"))  # noqa: S314 - written by the step before
    skipped = [
        (f"{case.get('classname')}::{case.get('name')}", found.get("message") or "")
        for case in cases
        if (found := case.find("skipped")) is not None and found.get("type") != "pytest.xfail"
    ]
    wrong = [(name, why) for name, why in skipped if not name.startswith(MAY_SKIP)]
    for _name, _why in wrong:
        pass
    return 1 if wrong or not cases else 0


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1])))
