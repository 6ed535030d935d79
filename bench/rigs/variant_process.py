"""A process that measures parts of the frame's path on its own variant of the modules.

It prints its variant, and reads a calibration as a line of JSON. For each name of a part that it
reads then, it prints a line of JSON: median CPU time of an item, µs, by name of the measurement. It
is a process of its own because the first import chooses the variant.
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
    """Answer until standard input ends."""
    print(running_variant(), flush=True)
    calibration = Calibration.from_dict(json.loads(sys.stdin.readline()))
    with patch.object(core, "worn", return_value=calibration):  # a fit takes longer than all parts
        for line in sys.stdin:
            results = PARTS[line.strip()](True)
            print(json.dumps({result.name: result.value for result in results}), flush=True)


if __name__ == "__main__":
    main()
