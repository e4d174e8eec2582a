"""Writes the list of files in docs/architecture.md: each with the first sentence of its docstring, room by room."""

from __future__ import annotations

import ast
import sys
from collections.abc import Iterator
from itertools import groupby
from pathlib import Path

from marked_page import with_part

REPOSITORY = Path(__file__).resolve().parents[1]
PAGE = REPOSITORY / "docs" / "architecture.md"
BEGIN = "<!-- The list below is made by scripts/make_architecture.py. -->"


def updated(page: str, package: Path = REPOSITORY / "gnrecon") -> str:
    """Return a page whose part after the mark is the list of a package's files.

    Raises
    ------
    ValueError
        When the page has no mark.
    """
    return with_part(page, BEGIN, list(lines(package)))


def lines(package: Path) -> Iterator[str]:
    """Yield a heading for each folder, and a line for each of its files, the package's own folder first."""
    sources = sorted(path.relative_to(package) for path in package.rglob("*.py") if "__pycache__" not in path.parts)
    for number, (folder, paths) in enumerate(
        groupby(sorted(sources, key=lambda path: path.parent), lambda p: p.parent)
    ):
        name = package.name if folder == Path() else f"{package.name}/{folder.as_posix()}"
        yield from ([""] if number else [])
        yield f"**{name}/**: {summary(package / folder / '__init__.py')}"
        yield ""
        for path in paths:
            if path.name != "__init__.py":
                yield f"- `{path.as_posix()}`: {summary(package / path)}"


def summary(path: Path) -> str:
    """Return the first paragraph of a file's docstring, in one line."""
    text = ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or ""
    return " ".join(text.partition("\n\n")[0].split())


def main() -> int:
    """Write the list."""
    PAGE.write_text(updated(PAGE.read_text(encoding="utf-8")), encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
