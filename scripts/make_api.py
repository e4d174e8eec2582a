"""Writes the signatures of all public names into docs/api.md, each below its heading; the prose is not changed.

If headings and public names differ, it prints the differences and writes nothing.
"""

from __future__ import annotations

import inspect
import re
import sys
from dataclasses import is_dataclass
from pathlib import Path
from typing import Any

import gnrecon

PAGE = Path(__file__).resolve().parents[1] / "docs" / "api.md"


def names(page: str) -> list[str]:
    """Return the names that a page has a heading for, in its order."""
    return re.findall(r"^### (\w+)\n", page, flags=re.MULTILINE)


def updated(page: str) -> str:
    """Return a page with the signature of each name below its heading."""
    parts = re.split(r"^### (\w+)\n", page, flags=re.MULTILINE)
    block_pattern = re.compile(r"\A\s*```text\n.*?^```\n", re.MULTILINE | re.DOTALL)
    for number in range(1, len(parts), 2):
        name, prose = parts[number], block_pattern.sub("", parts[number + 1]).strip("\n")
        lines = [*rendered(name), *(f"    {line}" for line in members(name))]
        block = "\n".join(["```text", *lines, "```", "", ""]) if lines else ""
        end = "\n" if number + 2 == len(parts) else "\n\n"
        parts[number], parts[number + 1] = f"### {name}\n", f"\n{block}{prose}{end}"
    return "".join(parts)


def rendered(name: str) -> list[str]:
    """Return the signature of a public name, in lines; none for strings and exceptions."""
    found = getattr(gnrecon, name)
    if not callable(found) or (inspect.isclass(found) and issubclass(found, Exception)):
        return []
    if name in ("Options", "FitOptions"):  # their fields are the options, which have a page of their own
        return [f"{name}(**options)"]
    return _wrapped(name, inspect.signature(found), own=not inspect.isclass(found))


def members(name: str) -> list[str]:
    """Return the public methods and properties of a class, in lines, in the order of their definition."""
    found = getattr(gnrecon, name)
    if not inspect.isclass(found) or issubclass(found, Exception):
        return []
    lines = []
    for key, member in vars(found).items():
        if key.startswith("_") or isinstance(member, type):
            continue
        if isinstance(member, property) or hasattr(member, "attrname"):
            read: Any = member.fget if isinstance(member, property) else member.func
            lines.append(f"{key}: {_typed(inspect.signature(read).return_annotation)}")
        elif callable(member) or isinstance(member, classmethod | staticmethod):
            lines += _wrapped(key, inspect.signature(getattr(found, key)), own=True)
    return lines


def _wrapped(name: str, signature: inspect.Signature, own: bool, *, width: int = 116) -> list[str]:
    """Return one line, or one per parameter if it exceeds `width` characters; `own` adds the type that is returned."""
    parts = _parameters(signature)
    end = f") -> {_typed(signature.return_annotation)}" if own else ")"
    line = f"{name}({', '.join(parts)}{end}"
    if len(line) <= width:
        return [line]
    return [f"{name}(", *(f"    {part}," for part in parts), end]


def _parameters(signature: inspect.Signature) -> list[str]:
    parts, starred = [], False
    for parameter in signature.parameters.values():
        if parameter.name == "self":
            continue
        if parameter.kind is parameter.KEYWORD_ONLY and not starred:
            parts.append("*")
            starred = True
        prefix = "**" if parameter.kind is parameter.VAR_KEYWORD else ""
        default = "" if parameter.default is parameter.empty else f" = {_shown(parameter.default)}"
        parts.append(f"{prefix}{parameter.name}: {_typed(parameter.annotation)}{default}")
    return parts


def _typed(annotation: Any) -> str:
    return annotation if isinstance(annotation, str) else getattr(annotation, "__name__", str(annotation))


def _shown(default: Any) -> str:
    if repr(default) == "<factory>":
        return "{}"
    if is_dataclass(default) and not isinstance(default, type) and default == type(default)():
        return f"{type(default).__name__}()"
    return default.__name__ if callable(default) else repr(default)


def main() -> int:
    """Update the page, and return the exit code."""
    page = PAGE.read_text(encoding="utf-8")
    wrong = sorted(set(names(page)) ^ set(gnrecon.__all__))
    if wrong:
        print(f"docs/api.md and gnrecon.__all__ differ in {', '.join(wrong)}.", file=sys.stderr)
        return 1
    PAGE.write_text(updated(page), encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
