"""The speed table: `python bench/speed.py [--rows PATTERN] [--quick] [--json FILE]`.

Measures every bench of ``bench/speed_rows``, prints figure and goal side by side and ends with 1
where a floor is missed. What each figure means is said in docs/speed.md.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import sys
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as the daemon's unit and its fits have it
sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # run as a script, from anywhere

from bench.framework.measurement import (
    Bench,
    Row,
    as_json,
    as_markdown,
    as_text,
    find_benches,
    machine,
)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rows", default="", metavar="PATTERN", help="benches whose id matches")
    parser.add_argument("--quick", action="store_true", help="few repeats, short runs")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures there, too")
    parser.add_argument("--markdown", action="store_true", help="print the table for docs")
    parser.add_argument("--list", action="store_true", help="list the benches")
    options = parser.parse_args()
    benches = [bench for bench in find_benches() if re.search(options.rows, bench.id)]
    if not benches:
        known = ", ".join(bench.id for bench in find_benches())
        parser.error(f"--rows {options.rows}: no bench matches; there are: {known}")
    if options.list:
        for bench in benches:
            print(f"{bench.id:12} {bench.title}")
        return 0
    measured = [(bench, _measured(bench, quick=options.quick)) for bench in benches]
    rows = [row for _, found in measured for row in found]
    print((as_markdown if options.markdown else as_text)(rows))
    print(_said(machine()), file=sys.stderr)
    if options.json:
        text = json.dumps(as_json(measured), indent=1, ensure_ascii=False)
        options.json.write_text(f"{text}\n", encoding="utf-8")
    missed = [row.name for row in rows if row.missed]
    if missed:
        print(f"floors missed: {'; '.join(missed)}", file=sys.stderr)
    return 1 if missed else 0


def _measured(bench: Bench, *, quick: bool) -> list[Row]:
    print(f"{bench.id}: {bench.title} …", file=sys.stderr, flush=True)
    return bench.run(quick)


def _said(about: dict[str, object]) -> str:
    return (
        f"{about['processor']}, {about['cores']} cores, {about['system']}, "
        f"Python {about['python']}; fixed loop {about['fixed_loop_us']} µs"
    )


if __name__ == "__main__":
    sys.exit(main())
