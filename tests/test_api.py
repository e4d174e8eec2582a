"""The public API: documented name by name, typed, explained, and nothing more than it says."""

from __future__ import annotations

import importlib
import inspect
from typing import Any

import make_api
import numpy as np
import pytest
from scan_files import torus

import gnrecon

PAGE = make_api.PAGE.read_text(encoding="utf-8")
CALLABLE = [name for name in gnrecon.__all__ if callable(getattr(gnrecon, name))]


def test_every_public_name_is_documented_once_and_nothing_else() -> None:
    assert sorted(make_api.names(PAGE)) == sorted(gnrecon.__all__)


def test_signatures_in_the_documents_are_those_of_the_code() -> None:
    assert make_api.updated(PAGE) == PAGE, "run scripts/make_api.py"


def test_signatures_are_written_where_they_are_missing_or_old() -> None:
    page = "# Title\n\n### Frame\n\nWhat it is.\n\n## Part\n\n### trim\n\n```text\nold(\n)\n```\n\nMore.\n"
    made = make_api.updated(page)
    assert "### Frame\n\n```text\nFrame(center: Float, scale: float)\n    of(points: Float) -> Frame\n" in made
    assert "```\n\nWhat it is.\n\n## Part\n\n### trim\n" in made
    result = ") -> tuple[Mesh, Trimming]\n```\n\nMore.\n"
    arguments = ["mesh: Mesh", "distances: Float", "reach: float", "*"]
    arguments += ["overhang: float | None = None", "parameters: TrimParameters | None = None"]
    assert "".join(["trim(\n", *(f"    {argument},\n" for argument in arguments), result]) in made
    assert "old(" not in made
    assert make_api.updated(made) == made


def members(name: str) -> list[tuple[str, Any]]:
    """A public callable, and the public methods and properties of a class that are its own."""
    found = getattr(gnrecon, name)
    inner = vars(found).items() if inspect.isclass(found) else ()
    own = [(f"{name}.{key}", value) for key, value in inner if not key.startswith("_")]
    return [(name, found), *((key, getattr(value, "fget", getattr(value, "func", value))) for key, value in own)]


@pytest.mark.parametrize("name", CALLABLE)
def test_public_objects_have_docstrings_and_types(name: str) -> None:
    for label, member in members(name):
        member = getattr(member, "__func__", member)
        if not callable(member):
            continue
        assert (member.__doc__ or "").strip(), label
        if inspect.isclass(member):
            continue
        signature = inspect.signature(member)
        assert signature.return_annotation is not signature.empty, label
        bare = [
            p.name for p in signature.parameters.values() if p.annotation is p.empty and p.name not in ("self", "cls")
        ]
        assert not bare, label


def test_the_rest_is_not_offered() -> None:
    assert [name for name in gnrecon.__all__ if name.startswith("_")] == ["__version__"]
    with pytest.raises(AttributeError, match="has no attribute 'no_such_name'"):
        gnrecon.no_such_name  # noqa: B018


def test_dir_is_what_is_public() -> None:
    assert dir(gnrecon) == sorted(gnrecon.__all__)


def test_a_function_is_not_lost_to_the_package_of_its_name() -> None:
    package = importlib.import_module("gnrecon.fit")
    samples, _ = gnrecon.prepare(gnrecon.as_cloud(*torus(300, np.random.default_rng(3))))
    options = gnrecon.FitOptions(widths=(20,), steps=0)
    fields = [fit(samples, options)[0] for fit in (package, package.fit)]  # type: ignore[operator]
    assert float(abs(fields[0].theta - fields[1].theta).max()) == 0
