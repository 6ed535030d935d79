"""Record the joint angles of a running rig as a CSV file: one row for every pose.

    python examples/record_angles.py leg/rig.toml --seconds 10 --out walk.csv

Broker and base topic are those of rig.toml. Unknown values are empty cells.
"""

from __future__ import annotations

import argparse
import csv
import json
import sys
import time
import tomllib
from pathlib import Path

import paho.mqtt.client as mqtt

ANSWER_S = 10.0
"""Time limit for the first pose, s."""


def main() -> int:
    """Subscribe to the poses, and write one row for each; return the exit code."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("rig", type=Path, help="rig.toml of the running daemon")
    parser.add_argument("--seconds", type=float, default=10.0, help="duration (default 10)")
    parser.add_argument("--out", type=Path, required=True, help="CSV file")
    options = parser.parse_args()
    broker = tomllib.loads(options.rig.read_text("utf-8"))["mqtt"]

    poses: list[dict] = []
    client = mqtt.Client(mqtt.CallbackAPIVersion.VERSION2, protocol=mqtt.MQTTv5)
    client.on_connect = lambda *_: client.subscribe(f"{broker['base']}/pose")
    client.on_message = lambda _, __, message: poses.append(json.loads(message.payload))
    client.connect(broker.get("host", "127.0.0.1"), broker.get("port", 1883))
    client.loop_start()
    until = time.monotonic() + ANSWER_S
    while not poses and time.monotonic() < until:
        time.sleep(0.01)
    time.sleep(options.seconds if poses else 0.0)
    client.loop_stop()
    if not poses:
        print(f"no pose on {broker['base']}/pose within {ANSWER_S:g} s: start jointfitd")
        return 1

    table = [row(pose, poses[0]["t_us"]) for pose in list(poses)]
    columns = list(dict.fromkeys(name for cells in table for name in cells))
    with options.out.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, columns)
        writer.writeheader()
        writer.writerows(table)
    print(f"{options.out}: {len(table)} rows, {len(columns)} columns")
    return 0


def row(pose: dict, begin_us: int) -> dict[str, float | None]:
    """Return the time since `begin_us`, angles and standard deviations of a pose, by column."""
    cells = {"t_s": (pose["t_us"] - begin_us) / 1e6}
    for joint, values in pose["joints"].items():
        degrees = {key: value for key, value in values.items() if key.endswith("_deg")}
        cells |= {f"{joint}_{key}": value for key, value in degrees.items()}
    return cells


if __name__ == "__main__":
    sys.exit(main())
