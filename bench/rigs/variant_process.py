"""Process that measures parts of the frame's path with one variant of the modules.

The process prints its variant, and reads a calibration as a line of JSON. Then it reads names of
parts. For each name, it prints a line of JSON with the median CPU time per item, µs, by
measurement. A separate process is necessary because the first import selects the variant.
"""

from __future__ import annotations

import json
import sys
from typing import TYPE_CHECKING
from unittest.mock import patch

from bench.experiments.speed import codec_natnet, codecs, core
from jointfit_daemon.limb_model import Calibration
from jointfit_variant import running_variant

if TYPE_CHECKING:
    from collections.abc import Callable

    from bench.framework.experiment import Result

PARTS: dict[str, Callable[[bool], list[Result]]] = {
    "xbus": codecs.xbus_rows,
    "can": codecs.xcdi_rows,
    "natnet": codec_natnet.own_rows,
    "clock": core.clock_rows,
    "aligner": core.align_rows,
    "fusion": core.fusion_rows,
    "core": core.core_rows,
}


def main() -> None:
    """Process the input until standard input ends."""
    print(running_variant(), flush=True)
    calibration = Calibration.from_dict(json.loads(sys.stdin.readline()))
    with patch.object(core, "worn", return_value=calibration):  # a fit would take long
        for line in sys.stdin:
            results = PARTS[line.strip()](True)
            print(json.dumps({result.name: result.value for result in results}), flush=True)


if __name__ == "__main__":
    main()
