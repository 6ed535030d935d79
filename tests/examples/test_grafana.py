"""Every query of the Grafana dashboard names an existing metric, label, measurement and field."""

from __future__ import annotations

import itertools
import json
import re
from collections import defaultdict
from pathlib import Path
from typing import Any

import promql_parser
import pytest

from jointfit_daemon.outputs.metrics import FrameStatistics
from jointfit_daemon.outputs.metrics._families import metric_families
from tests.examples.live_rig import BASE
from tests.examples.test_telegraf import point_of
from tests.outputs.metrics.test_metrics import HEALTH

DASHBOARD: dict[str, Any] = json.loads(
    (Path(__file__).resolve().parents[2] / "examples" / "grafana" / "jointfitd.json").read_text(
        encoding="utf-8"
    )
)
PANELS: list[dict[str, Any]] = [p for p in DASHBOARD["panels"] if p["type"] != "row"]
TARGETS = [(panel["title"], target) for panel in PANELS for target in panel["targets"]]
VARIABLES = {one["name"] for one in DASHBOARD["templating"]["list"]}
BUILT_IN = {"__interval", "__rate_interval", "timeFilter", "tag_joint"}
SCRAPED = {"job", "instance"}
"""Labels that Prometheus adds."""
UNITS = {"none", "s", "degree", "hertz", "cps", "short", "percentunit", "bytes"}
INFLUX = re.compile(
    r'SELECT (?:mean|max)\("(?P<field>\w+)"\) FROM "(?P<measurement>\w+)" WHERE \$timeFilter'
    r' AND "(?P<tag>\w+)" =~ /\^\$rig\$/ GROUP BY time\(\$__interval\), "(?P<by>\w+)" fill\(null\)'
)


def exposed() -> dict[str, set[str]]:
    """Return the labels of every metric that the daemon can expose, by name of the metric."""
    found: dict[str, set[str]] = defaultdict(set)
    frames = FrameStatistics()
    frames.calibrated_s = 1.0
    for family in metric_families("r", HEALTH, frames):
        for sample in family.samples:
            found[sample.name] |= set(sample.labels)
    return found


def selectors(node: Any) -> list[Any]:
    """Return the selectors of a parsed query."""
    if isinstance(node, promql_parser.VectorSelector):
        return [node]
    parts = [
        getattr(node, name)
        for name in ("expr", "lhs", "rhs", "vector_selector", "param")
        if getattr(node, name, None) is not None
    ]
    parts += list(getattr(node, "args", None) or [])
    return [selector for part in parts for selector in selectors(part)]


def promql(query: str) -> Any:
    return promql_parser.parse(query.replace("$__rate_interval", "1m"))


@pytest.mark.parametrize(
    ("title", "query"),
    [(title, target["expr"]) for title, target in TARGETS if "expr" in target],
)
def test_a_query_of_prometheus_names_metrics_and_labels_of_the_daemon(
    title: str, query: str
) -> None:
    known, found = exposed(), selectors(promql(query))
    assert found, title
    for selector in found:
        assert selector.name in known, selector.name
        labels = {matcher.name for matcher in selector.matchers.matchers}
        assert labels <= known[selector.name] | SCRAPED
    counters = re.findall(r"(\w+_total|\w+_bucket)", query)
    assert all(f"rate({name}" in query for name in counters)


def test_a_query_of_an_unknown_metric_is_noticed() -> None:
    (selector,) = selectors(promql("sum by (le) (rate(jointfit_no_such_total[1m]))"))
    assert selector.name not in exposed()


@pytest.mark.parametrize(
    ("title", "target"), [(title, target) for title, target in TARGETS if "query" in target]
)
def test_a_query_of_influxdb_names_a_measurement_that_telegraf_writes(
    title: str, target: dict[str, Any]
) -> None:
    found = INFLUX.fullmatch(target["query"])
    assert found is not None, title
    point = point_of(f"{BASE}/joint/knee")
    assert found["measurement"] == point["measurement"]
    assert found["field"] in point["fields"]
    assert {found["tag"], found["by"]} <= point["tags"].keys()


def test_the_dashboard_uses_its_own_variables_and_data_sources() -> None:
    text = json.dumps(DASHBOARD)
    used = set(re.findall(r"\$\{?(\w+)\}?", text.replace("$/", "/")))
    assert used <= VARIABLES | BUILT_IN
    assert {"prometheus", "influxdb"} <= VARIABLES
    sources = {panel["datasource"]["uid"] for panel in PANELS}
    assert sources == {"${prometheus}", "${influxdb}"}
    for panel in PANELS:
        assert {target["datasource"]["uid"] for target in panel["targets"]} == {
            panel["datasource"]["uid"]
        }
    assert re.search(r"label_values\(jointfit_build_info", text)


def test_panels_have_a_title_a_description_a_unit_and_do_not_overlap() -> None:
    ids = [panel["id"] for panel in DASHBOARD["panels"]]
    assert len(set(ids)) == len(ids)
    for panel in PANELS:
        assert panel["title"]
        assert panel["description"].endswith(".")
        assert panel["fieldConfig"]["defaults"]["unit"] in UNITS
    boxes = [panel["gridPos"] for panel in DASHBOARD["panels"]]
    for a, b in itertools.combinations(boxes, 2):
        apart_x = a["x"] + a["w"] <= b["x"] or b["x"] + b["w"] <= a["x"]
        apart_y = a["y"] + a["h"] <= b["y"] or b["y"] + b["h"] <= a["y"]
        assert apart_x or apart_y, (a, b)
    assert all(box["x"] >= 0 and box["x"] + box["w"] <= 24 for box in boxes)
