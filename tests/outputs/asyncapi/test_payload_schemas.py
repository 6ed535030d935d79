"""Schemas of payloads and requests: complete, valid, and equal to the documents in docs."""

from __future__ import annotations

import gzip
import hashlib
import json
import re
from pathlib import Path
from typing import Any

import jsonschema
import orjson
import pytest
from typer.testing import CliRunner

from jointfit_daemon.outputs.payload_models import (
    ANSWERS,
    PAYLOADS,
    answer_schema,
    payload_schema,
    payload_topic,
)
from jointfit_daemon.outputs.topics import OFFLINE, REQUEST, RESPONSE, TOPICS
from jointfit_daemon.supervisor.requests import REQUESTS
from jointfit_daemon.tools.__main__ import app
from jointfit_daemon.tools.schema._asyncapi import asyncapi_document, request_schema
from tests.payload_check import payload_fault

HERE = Path(__file__).parent
DOCS = HERE.parents[2] / "docs"
PAGE = DOCS / "mqtt.md"
SPECIFICATION = HERE / "asyncapi-3.0.0.json.gz"
SHA256 = "abe96881dbfaad495ccbb6bd8d3fb43ca18a13b9d7564849ccb66f39d5e5b20f"
run = CliRunner().invoke


def schemas() -> dict[str, dict[str, Any]]:
    """Return all schemas by title."""
    found = [
        *map(payload_schema, PAYLOADS), *map(answer_schema, ANSWERS), *map(request_schema, REQUESTS)
    ]  # fmt: skip
    return {schema["title"]: schema for schema in found}


def test_every_topic_request_and_answer_has_a_schema() -> None:
    assert {*PAYLOADS, REQUEST} == set(TOPICS)
    assert ANSWERS.keys() == REQUESTS.keys()
    assert payload_topic("joint/knee") is payload_topic("joint/Knie")
    assert payload_topic("device/S1/info") is not payload_topic("device/S1/availability")
    assert payload_topic("bridge/response/mark") is RESPONSE
    assert payload_topic("pose/more") is None


@pytest.mark.parametrize("title", schemas())
def test_every_schema_is_one(title: str) -> None:
    jsonschema.Draft202012Validator.check_schema(schemas()[title])


def test_the_document_is_valid_asyncapi() -> None:
    text = gzip.decompress(SPECIFICATION.read_bytes())
    assert hashlib.sha256(text).hexdigest() == SHA256
    validator = jsonschema.Draft7Validator(json.loads(text))
    document = asyncapi_document()
    assert [error.message[:200] for error in validator.iter_errors(document)] == []

    del document["channels"]["pose"]["messages"]["Pose"]["payload"]
    document["operations"]["send_pose"]["action"] = "publish"
    assert list(validator.iter_errors(document))


def test_every_reference_of_the_document_leads_somewhere() -> None:
    document = asyncapi_document()
    references = set(re.findall(r'"\$ref":"(#[^"]+)"', orjson.dumps(document).decode()))
    assert len(references) > 40
    for reference in references:
        place: Any = document
        for level in reference.removeprefix("#/").split("/"):
            place = place[level]


def test_document_and_page_name_the_same_topics_and_requests() -> None:
    page = PAGE.read_text(encoding="utf-8")
    topics = re.findall(r"^\| `([^`]+)` \| [R–] \| [01] \|", page, re.MULTILINE)
    table = page.partition("| command | arguments | effect |\n|---|---|---|\n")[2]
    requests = re.findall(r"^\| `([\w-]+)` \|", table.partition("\n\n")[0], re.MULTILINE)
    assert requests == list(REQUESTS)

    expected = {topic for topic in topics if "COMMAND" not in topic}
    for name in requests:
        expected |= {f"bridge/request/{name}", f"bridge/response/{name}"}
    found = {channel["address"] for channel in asyncapi_document()["channels"].values()}
    assert found == {
        "{base}/" + topic.replace("/ID/", "/{id}/").replace("/NAME", "/{name}")
        for topic in expected
    }


def test_every_argument_of_a_request_is_on_the_page() -> None:
    table = PAGE.read_text(encoding="utf-8").partition("| command | arguments | effect |")[2]
    for name, kind in REQUESTS.items():
        (row,) = re.findall(rf"^\| `{name}` \|.*$", table, re.MULTILINE)
        for key in kind.model.model_fields.keys() - {"transaction"}:
            assert f"`{key}`" in row or f'"{key}"' in row, (name, key)


def test_document_in_docs_is_the_one_of_the_command() -> None:
    printed = run(app, ["schema", "--asyncapi"]).stdout
    text = (DOCS / "asyncapi.json").read_text(encoding="utf-8")
    assert orjson.loads(text) == orjson.loads(printed), (
        "write it again: jointfit schema --asyncapi > docs/asyncapi.json"
    )


def test_examples_of_the_page_fit_their_models() -> None:
    page = PAGE.read_text(encoding="utf-8")
    found = 0
    for section in re.split(r"^## ", page, flags=re.MULTILINE):
        name = section.partition("\n")[0].strip("`")
        for text in re.findall(r"```json\n(.*?)```", section, re.DOTALL):
            payload = orjson.loads(text)
            topic = "bridge/health" if "link" in payload else name
            if "v" in payload:
                found += 1
                missing = {"state": {"fault": None, "not_stored": None}, "fusion": {}}
                more = missing if topic == "bridge/health" else {}
                assert payload_fault(topic, more | payload) is None
    assert found >= 6


def test_a_payload_with_an_unknown_key_or_type_does_not_fit() -> None:
    good = orjson.loads(OFFLINE)
    assert payload_fault("bridge/state", good) is None
    assert payload_fault("bridge/state", good | {"more": 1}) is not None
    assert payload_fault("bridge/state", good | {"state": "away"}) is not None
    # readers ignore unknown keys, so the published schema permits them
    jsonschema.validate(good | {"more": 1}, payload_schema(payload_topic("bridge/state")))  # type: ignore[arg-type]


def test_the_command_prints_one_schema_and_names_the_nearest_topic() -> None:
    shown = orjson.loads(run(app, ["schema", "bridge/request/mark"]).stdout)
    assert shown["properties"]["text"]["maxLength"] == 200
    assert orjson.loads(run(app, ["schema", "joint/knee"]).stdout)["title"] == "JointScalars"
    wrong = run(app, ["schema", "poze"])
    assert wrong.exit_code == 2
    assert "did you mean 'pose'?" in wrong.stderr
