"""The JSON schema of the report: `report.schema.json` in this folder gives the meaning and unit of each field.

It is in JSON Schema 2020-12. To print it loads no torch.
"""

from __future__ import annotations

import json
from importlib import resources
from typing import Any

SCHEMA_VERSION = "1.0"
"""Of the report: the first number grows when a field goes or changes its meaning, the second when one is added."""


def schema_text() -> str:
    """Return the schema as the text of a JSON file."""
    return (resources.files("gnrecon.report") / "report.schema.json").read_text(encoding="utf-8")


def report_schema() -> dict[str, Any]:
    """Return the JSON schema of `Reconstruction.report`, which ``--report`` writes."""
    schema: dict[str, Any] = json.loads(schema_text())
    return schema
