"""glTF with its JSON in a text file, and its buffers inside of that or in files beside it: read as the GLB of the same.

A GLB has one buffer, so all buffers are put in a row, and the views into them are moved.
"""

from __future__ import annotations

import binascii
import json
from pathlib import Path
from typing import Any
from urllib.parse import unquote

from gnrecon.io.contents import Contents, parsing
from gnrecon.io.glb import packed, read_glb_bytes
from gnrecon.io.parse import beside
from gnrecon.runtime.errors import InputError


def read_gltf(path: Path) -> Contents:
    """Read all meshes and clouds of the scene into one, as `read_glb` does.

    Raises
    ------
    InputError
        When the file is malformed, holds no vertices, or a buffer is missing.
    """
    with parsing("glTF"):
        tree = json.loads(path.read_bytes())
        buffers = [_buffer(one["uri"], path.parent) for one in tree.get("buffers", [])]
        starts = [0]
        for buffer in buffers:
            starts.append(starts[-1] + len(buffer) + -len(buffer) % 4)
        for view in tree.get("bufferViews", []):
            view["byteOffset"] = view.get("byteOffset", 0) + starts[view["buffer"]]
            view["buffer"] = 0
        data = packed(_with_one_buffer(tree, starts[-1]), _chunk(buffers))
    return read_glb_bytes(data)


def _with_one_buffer(tree: dict[str, Any], size: int) -> dict[str, Any]:
    return {**tree, "buffers": [{"byteLength": size}]}


def _chunk(buffers: list[bytes]) -> bytes:
    body = b"".join(buffer + b"\0" * (-len(buffer) % 4) for buffer in buffers)
    return len(body).to_bytes(4, "little") + b"BIN\0" + body


def _buffer(uri: str, folder: Path) -> bytes:
    """The bytes of a data URI, or of a file in or below the scene's folder."""
    if uri.startswith("data:"):
        return binascii.a2b_base64(uri.partition(",")[2])
    target = beside(folder, unquote(uri), "buffer")
    if not target.is_file():
        raise InputError(f"the buffer {uri[:80]!r} is missing beside the file.")
    return target.read_bytes()
