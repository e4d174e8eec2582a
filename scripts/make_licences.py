"""Writes docs/licences.md: the licence of each package that gnrecon requires, itself or through others.

The licences are those that the installed packages state in their metadata.
"""

from __future__ import annotations

import configparser
import re
import sys
from collections.abc import Iterator
from importlib.metadata import Distribution, PackageNotFoundError, distribution
from pathlib import Path

from marked_page import with_part

REPOSITORY = Path(__file__).resolve().parents[1]
PAGE = REPOSITORY / "docs" / "licences.md"
BEGIN = "<!-- The table below is made by scripts/make_licences.py. -->"


def required(extras: tuple[str, ...] = ("e57", "cluster", "figures")) -> dict[str, str]:
    """Return the packages that setup.cfg names, with the extra that needs each, or an empty text."""
    settings = configparser.ConfigParser()
    settings.read(REPOSITORY / "setup.cfg", encoding="utf-8")
    found = {_name(line): extra for extra in extras for line in _lines(settings["options.extras_require"][extra])}
    return found | dict.fromkeys(map(_name, _lines(settings["options"]["install_requires"])), "")


def closure(names: dict[str, str]) -> dict[str, str]:
    """Return these packages and all that they need, each with the extra that needs it, or an empty text."""
    found: dict[str, str] = {}
    # What every installation needs comes last and replaces what an extra needs as well.
    waiting = sorted(names.items(), key=lambda item: item[1] == "")
    while waiting:
        name, extra = waiting.pop(0)
        if name in found and (found[name] == "" or found[name] == extra):
            continue
        found[name] = extra
        package = _installed(name)
        for line in (package.requires or []) if package is not None else []:
            if "extra ==" not in line and _installed(_name(line)) is not None:
                waiting.append((_name(line), extra))
    return found


def licence(name: str) -> str:
    """Return what a package's metadata says of its licence, in one short line."""
    package = _installed(name)
    if package is None:
        return "not installed"
    metadata = package.metadata
    classified = [
        line.rpartition("::")[2].strip()
        for line in metadata.get_all("Classifier", [])
        if line.startswith("License ::") and line.count("::") > 1
    ]
    expression, text = ((metadata.get_all(field) or [""])[0] for field in ("License-Expression", "License"))
    words = expression or "; ".join(classified) or text or "not stated"
    return words.strip().splitlines()[0][:80]


def updated(page: str) -> str:
    """Return a page whose part after the mark is the table.

    Raises
    ------
    ValueError
        When the page has no mark.
    """
    rows = [f"| {name} | {licence(name)} | {extra} |" for name, extra in sorted(closure(required()).items())]
    return with_part(page, BEGIN, ["| package | licence | only with |", "|---|---|---|", *rows])


def _lines(text: str) -> Iterator[str]:
    return (line for line in text.splitlines() if line.strip())


def _name(requirement: str) -> str:
    """Return a requirement's package, in the spelling of package indices."""
    found = re.match(r"[A-Za-z0-9._-]+", requirement.strip())
    assert found is not None
    return re.sub(r"[-_.]+", "-", found[0]).lower()


def _installed(name: str) -> Distribution | None:
    try:
        return distribution(name)
    except PackageNotFoundError:
        return None


def main() -> int:
    """Write the page."""
    PAGE.write_text(updated(PAGE.read_text(encoding="utf-8")), encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
