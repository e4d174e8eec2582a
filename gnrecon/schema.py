"""The JSON schema of the report: what each field means, and in which unit.

It is data of the package, `report.schema.json`, in the dialect of JSON Schema's draft 2020-12. Reports name the version
that they follow: the first number grows when a field goes or changes its meaning, the second when one is added.
"""

from __future__ import annotations

import json
from importlib import resources
from typing import Any

SCHEMA_VERSION = "1.0"


def schema_text() -> str:
    """Return the schema as the text of a JSON file."""
    return (resources.files("gnrecon") / "report.schema.json").read_text(encoding="utf-8")


def report_schema() -> dict[str, Any]:
    """Return the JSON schema of `Reconstruction.report`, which ``--report`` writes."""
    schema: dict[str, Any] = json.loads(schema_text())
    return schema
