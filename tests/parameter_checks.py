"""Checks of the dataclasses of parameters: that they are frozen, and that their fields are used."""

from __future__ import annotations

import ast
from dataclasses import FrozenInstanceError, fields, is_dataclass
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest


def assert_frozen(parameters: Any) -> None:
    """Check that no field can be set."""
    for field in fields(parameters):
        with pytest.raises(FrozenInstanceError):
            setattr(parameters, field.name, None)


def field_names(parameters: Any) -> list[str]:
    """Return the names of all fields of a class, those of nested parameters included."""
    found = []
    for field in fields(parameters):
        found.append(field.name)
        value = getattr(parameters(), field.name)
        if is_dataclass(value):
            found += field_names(type(value))
    return found


@cache
def read_attributes(package: ModuleType, leave_out: str = "") -> frozenset[str]:
    """Return the names of all attributes in the sources of a package, without those of one file."""
    assert package.__file__ is not None
    sources = [path for path in Path(package.__file__).parent.rglob("*.py") if path.name != leave_out]
    trees = [ast.parse(path.read_text(encoding="utf-8")) for path in sources]
    return frozenset(node.attr for tree in trees for node in ast.walk(tree) if isinstance(node, ast.Attribute))
