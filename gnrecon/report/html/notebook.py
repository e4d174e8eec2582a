"""A result in a Jupyter notebook: its picture and facts where it is the value of a cell, and the page on demand."""

from __future__ import annotations

import base64
import io
import sys
import tempfile
import webbrowser
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from markupsafe import Markup, escape

from gnrecon.geometry.mesh import Mesh
from gnrecon.geometry.point_cloud import PointCloud
from gnrecon.rendering import render
from gnrecon.report.html import facts


def result_html(
    report: Mapping[str, Any], mesh: Mesh, cloud: PointCloud | None = None, *, size: tuple[int, int] = (900, 420)
) -> str:
    """Return a result as HTML for a notebook: the scan and the mesh as a picture, and the page's headlines.

    Parameters
    ----------
    report, mesh, cloud : as of `gnrecon.write_page`
    size : width and height of the picture, in pixels
    """
    if not len(mesh.faces):
        return str(Markup("<p>A mesh without faces.</p>"))
    cells = [
        Markup(
            '<div style="margin:0 2em .4em 0"><b style="font-size:1.25em">{}</b> {}<br><small>{}</small></div>'
        ).format(fact.value, fact.label, fact.note)
        for fact in facts.headlines(report)
    ]
    picture = Markup('<img src="data:image/png;base64,{}" alt="{}" style="max-width:100%;border-radius:6px">').format(
        _png(mesh, cloud, size), "The scan and the mesh" if cloud is not None else "The mesh"
    )
    return str(
        Markup(
            '<div><p><b>{}</b>: {}</p>{}<div style="display:flex;flex-wrap:wrap;margin-top:.6em">{}</div></div>'
        ).format(facts.title(report), facts.verdict(report), picture, Markup().join(cells))
    )


def _png(mesh: Mesh, cloud: PointCloud | None, size: tuple[int, int]) -> str:
    """The picture as a PNG file in base 64."""
    from PIL import Image

    file = io.BytesIO()
    Image.fromarray(render(mesh, size=size, points=cloud)).save(file, format="PNG")
    return base64.b64encode(file.getvalue()).decode("ascii")


def show_page(page: str, *, height: int = 720) -> Path | None:
    """Show a page below the cell of a notebook or, elsewhere, in the web browser.

    Parameters
    ----------
    page : text of the page, as `gnrecon.report.html.page_text` makes it
    height : in a notebook, pixels

    Returns
    -------
    The file that the browser shows, in the folder for temporary files; None in a notebook.
    """
    if _in_notebook():
        from IPython.display import display_html

        # In a frame of its own, so that styles and scripts of page and notebook do not meet.
        frame = Markup('<div><iframe srcdoc="{}" style="width:100%;height:{}px;border:0"></iframe></div>')
        display_html(str(frame.format(escape(page), height)), raw=True)  # type: ignore[no-untyped-call]
        return None
    with tempfile.NamedTemporaryFile("w", suffix=".html", prefix="gnrecon-", delete=False, encoding="utf-8") as file:
        file.write(page)
    path = Path(file.name)
    webbrowser.open(path.as_uri())
    return path


def _in_notebook() -> bool:
    """Whether the process is the kernel of a notebook; IPython is not imported for this."""
    ipython = sys.modules.get("IPython")
    return ipython is not None and hasattr(ipython.get_ipython(), "kernel")
