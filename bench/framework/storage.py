"""Results as JSON files in ``bench/results``, one per experiment.

The files are committed, and the pages of docs are generated from them. They contain no date and no
path. Values have as many digits as on the pages, so a repeated run changes measured times only.
"""

from __future__ import annotations

import json
from dataclasses import replace
from math import inf
from pathlib import Path
from typing import TYPE_CHECKING, Any

from bench.framework.experiment import Result

if TYPE_CHECKING:
    from collections.abc import Sequence

    from bench.framework.experiment import Experiment

RESULTS = Path(__file__).resolve().parents[1] / "results"
MACHINE = "machine"
"""Name of the file that describes the machine on which times were measured."""


def shown(value: float) -> float:
    """Return the value rounded as in the tables: to 3 decimals, or 3 digits if it is below 0.01."""
    value = float(value)
    if 0.0 < abs(value) < 0.01:
        return float(f"{value:.3g}")
    return round(value, 3)


def to_json(experiment: Experiment, results: Sequence[Result]) -> dict[str, Any]:
    """Return experiment and results as JSON values.

    Infinite values become strings, and missing limits become null.
    """
    return {
        "experiment": experiment.id,
        "topic": experiment.topic,
        "title": experiment.title,
        "subjects": experiment.material.subjects,
        "reference": experiment.material.reference,
        "command": f"python -m bench {experiment.id}",
        "recordings": list(experiment.recordings),
        "packages": list(experiment.packages),
        "part_of": "make bench" if in_short_run(experiment) else "make bench-full",
        "results": [
            {
                "name": result.name,
                "value": _number(_value(result)),
                "unit": result.unit,
                "minimum": _limit(result.minimum),
                "maximum": _limit(result.maximum),
                **({} if result.target is None else {"target": result.target}),
                **({} if result.ratio is None else {"ratio": result.ratio}),
                **({"note": result.note} if result.note else {}),
                "met": bool(result.met),
                **(
                    {"reason": experiment.known_misses[result.name]}
                    if not result.met and result.name in experiment.known_misses
                    else {}
                ),
            }
            for result in results
        ],
    }


def in_short_run(experiment: Experiment) -> bool:
    """Return whether `make bench` runs the full experiment."""
    if experiment.quick_run is not None:
        return False
    return experiment.headline or not (experiment.long or experiment.timed)


def _value(result: Result) -> float:
    """Return the value as shown; with all digits if rounding changes whether a threshold is met."""
    value = shown(result.value)
    is_same = replace(result, value=value).met == result.met
    return value if is_same else float(result.value)


def _number(value: float) -> float | str:
    return value if abs(value) < inf else str(value)


def _limit(value: float) -> float | None:
    return float(f"{value:.6g}") if abs(value) < inf else None


def store(name: str, content: dict[str, Any], folder: Path = RESULTS) -> Path:
    """Write one file to `folder`; return its path."""
    folder.mkdir(exist_ok=True)
    path = folder / f"{name}.json"
    path.write_text(_one_line_each(content), encoding="utf-8")
    return path


def _one_line_each(content: dict[str, Any]) -> str:
    """Return JSON text with one line for each key and for each result."""
    lines = []
    for key, value in content.items():
        text = json.dumps(value, ensure_ascii=False)
        if key == "results":
            entries = [json.dumps(entry, ensure_ascii=False) for entry in value]
            text = "[\n  " + ",\n  ".join(entries) + "\n ]"
        lines.append(f" {json.dumps(key)}: {text}")
    return "{\n" + ",\n".join(lines) + "\n}\n"


def load(name: str, folder: Path = RESULTS) -> dict[str, Any]:
    """Return the content of one file of `folder`."""
    content: dict[str, Any] = json.loads((folder / f"{name}.json").read_text(encoding="utf-8"))
    return content


def results_of(content: dict[str, Any]) -> list[Result]:
    """Return the results in the content of a file."""
    return [
        Result(
            name=entry["name"],
            value=float(entry["value"]),
            maximum=inf if entry["maximum"] is None else entry["maximum"],
            minimum=-inf if entry["minimum"] is None else entry["minimum"],
            unit=entry["unit"],
            target=entry.get("target"),
            ratio=entry.get("ratio"),
            note=entry.get("note", ""),
        )
        for entry in content["results"]
    ]
