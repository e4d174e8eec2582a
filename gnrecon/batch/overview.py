"""The summary to look at: one HTML file with a picture of each mesh, its figures, and the failures by their causes."""

from __future__ import annotations

import base64
import io
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any
from urllib.parse import quote

from jinja2 import Environment, FileSystemLoader
from markupsafe import Markup

from gnrecon.batch.outcome import FILES, Cause
from gnrecon.report.html import style_text
from gnrecon.report.report.html import scales as numbers

COLORS = 64
"""Of a thumbnail on the page."""

WORDS = {
    Cause.INPUT: "the scan cannot be read or reconstructed",
    Cause.USAGE: "the options do not fit the scan",
    Cause.FIT: "the fit failed",
    Cause.MESH: "the mesh is not sound",
    Cause.OUTPUT: "a file could not be written",
    Cause.MEMORY: "not enough memory",
    Cause.TIMEOUT: "it took too long",
    Cause.SIGNAL: "the process was killed",
    Cause.UNFORESEEN: "a fault of gnrecon",
    Cause.INTERRUPTED: "interrupted",
}
"""What each cause means, in a few words."""


def overview_text(account: Mapping[str, Any], folder: Path) -> str:
    """Return the page as text.

    Parameters
    ----------
    account : as `Account.as_dict` gives it
    folder : that the page is to lie in, from which it links to the files
    """
    environment = Environment(
        loader=FileSystemLoader(Path(__file__).parent), autoescape=True, trim_blocks=True, lstrip_blocks=True
    )
    environment.filters |= {
        "count": numbers.count,
        "figure": numbers.figure,
        "seconds": numbers.seconds,
        "memory": numbers.memory,
        "percent": lambda value: numbers.share(value, 1.0),
    }
    scans = [_row(scan, folder) for scan in account["scans"]]
    causes = [
        {"name": name, "words": WORDS[Cause(name)], "scans": [scan for scan in scans if scan["cause"] == name]}
        for name in account["causes"]
    ]
    return environment.get_template("overview.html.j2").render(
        account=account,
        folder=folder.absolute().name,
        scans=scans,
        causes=causes,
        compared=any(scan["metrics"] for scan in scans),
        style=Markup(style_text()),
    )


def _row(scan: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    links = [(kind, _link(scan[kind], folder)) for kind in FILES if scan[kind]]
    links += [("log", _link(scan["log"], folder))] if scan["log"] else []
    return {**scan, "links": links, "picture": _picture(scan["thumbnail"])}


def _link(path: str, folder: Path) -> str:
    return quote(os.path.relpath(path, folder))


def _picture(path: str) -> str | None:
    """A picture as a data URI, in few colours, because a page may hold thousands; None where it is not there."""
    from PIL import Image

    packed = io.BytesIO()
    try:
        with Image.open(path) as picture:
            picture.convert("RGB").quantize(COLORS).save(packed, format="PNG", optimize=True)
    except OSError:
        return None
    return f"data:image/png;base64,{base64.b64encode(packed.getvalue()).decode('ascii')}"
