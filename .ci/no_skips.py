"""Fail when a test that CI must run was skipped: `no_skips.py [--minimal] JUNIT.xml ...`.

Some tests may be skipped. Tests of tests/vm may be skipped, because a later step of CI runs them on
a kernel with vcan and fails if one is skipped. Tests may be skipped if their requirement cannot be
installed: recordings that are not part of the project, a network interface with multicast, or
packages that need hardware. Parts of the conformance suite that a protocol excludes may be skipped.
On the minimal system, tests that need a Debian package may also be skipped; on other systems, they
must run.
"""

import sys
from pathlib import Path
from xml.etree import ElementTree as ET

MAY_SKIP = "tests.vm."
NOT_INSTALLABLE = (
    "recordings are not here",
    "vectors.json is not here",
    "loopback carries no multicast here",
    "Adafruit's packages are not here",
    "this wire detects damage itself, or does not allow its detection",
    "this wire does not allow detection of a wrong device",
    "bytes of this wire take no time",
    "the orientation filter begins again",
)
"""Reasons for which a clean machine may skip tests. They are counted and printed."""
NOT_IN_MINIMAL = (
    *(
        f"(Debian: apt install {package})"
        for package in ("mosquitto", "systemd", "groff-base", "gcc python3-dev")
    ),
    "needs a host whose own name has an address",
    "make mutation installs it",
)
"""Additional reasons for which the minimal system may skip tests."""


def skipped(cases: list[ET.Element]) -> list[tuple[str, str]]:
    """Return name and reason of each skipped test, except expected failures and tests/vm."""
    return [
        (name, found.get("message") or "no reason given")
        for case in cases
        for found in case.iter("skipped")
        if found.get("type") != "pytest.xfail"
        and not (name := f"{case.get('classname')}::{case.get('name')}").startswith(MAY_SKIP)
    ]


def main(words: list[str]) -> int:
    """Print the skipped tests; return 1 if a required test was skipped or no test ran."""
    reports = [Path(word) for word in words if word != "--minimal"]
    allowed = NOT_INSTALLABLE + (NOT_IN_MINIMAL if "--minimal" in words else ())
    trees = [ET.parse(report) for report in reports]  # noqa: S314 - pytest's, just made
    cases = [case for tree in trees for case in tree.getroot().iter("testcase")]
    found = skipped(cases)
    wrong = [each for each in found if not any(reason in each[1] for reason in allowed)]
    for name, reason in wrong:
        print(f"skipped, but CI must run it: {name}: {reason}")
    for reason in allowed:
        if count := sum(reason in each[1] for each in found):
            print(f"{count} tests skipped: {reason}")
    print(f"{len(cases)} tests, {len(wrong)} wrongly skipped")
    return 1 if wrong or not cases else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
