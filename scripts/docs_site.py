"""Hooks of mkdocs: pages that are made from the repository, and links from docs/ to files outside of it.

``mkdocs.yml`` names this file. The site has, besides docs/, the changelog, the page for contributors, and a reference
that is made from the docstrings of all public names. Links to source files, which the site does not have, become text.
"""

from __future__ import annotations

import re
from importlib import import_module
from pathlib import Path
from typing import Any

import gnrecon

REPOSITORY = Path(__file__).resolve().parents[1]
PAGES = ("CHANGELOG.md", "CONTRIBUTING.md")
LINK = re.compile(r"\[([^\]]+)\]\(([^)\s]+)\)")


def reference() -> str:
    """Return the page of the reference: a heading for each public name, which mkdocstrings fills."""
    names = [name for name in gnrecon.__all__ if name != "__version__"]
    parts = ["# Reference", "From the docstrings of all public names, in the order of the alphabet."]
    return "\n\n".join([*parts, *(f"::: {_path(name)}" for name in sorted(names, key=str.lower))]) + "\n"


def _path(name: str) -> str:
    """Where mkdocstrings, which reads the source and runs nothing, finds a public name."""
    package = REPOSITORY / "gnrecon" / name
    if package.is_dir() or package.with_suffix(".py").is_file():  # of a room of the same name, it would take the room
        found = getattr(import_module(f"gnrecon.{name}"), name)
        return f"{found.__module__}.{found.__qualname__}"
    return f"gnrecon.{name}"


def inside(text: str, page: str) -> str:
    """Return the Markdown of a page with its links into the site; those to other files of the repository become text.

    Parameters
    ----------
    text : Markdown
    page : path of the page in the repository, such as ``docs/research/README.md``
    """

    def link(match: re.Match[str]) -> str:
        label, target = match.groups()
        path, sign, anchor = target.partition("#")
        if not path or "://" in target or target.startswith("mailto:"):
            return match[0]
        found = ((REPOSITORY / page).parent / path).resolve()
        if not found.is_relative_to(REPOSITORY) or not found.exists():
            return match[0]  # a broken link, which mkdocs reports
        place = found.relative_to(REPOSITORY).as_posix()
        if place in PAGES or place.startswith("docs/"):
            here = page.removeprefix("docs/").count("/") * "../"
            return f"[{label}]({here}{place.removeprefix('docs/')}{sign}{anchor})"
        return label

    return LINK.sub(link, text)


def on_files(files: Any, config: Any) -> Any:
    """Add the pages that are not in docs/."""
    from mkdocs.structure.files import File

    for name in PAGES:
        text = inside((REPOSITORY / name).read_text(encoding="utf-8"), name)
        files.append(File.generated(config, name, content=text))
    files.append(File.generated(config, "reference.md", content=reference()))
    return files


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Turn links to files outside of docs/ into links within the site, or text."""
    if page.file.src_uri in (*PAGES, "reference.md"):
        return markdown
    return inside(markdown, f"docs/{page.file.src_uri}")
