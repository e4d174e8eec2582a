"""Files that a scan's file names: the scans of a ``.conf``, buffers and images of a glTF, materials and textures."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from pathlib import Path
from urllib.parse import unquote

from gnrecon.io.formats.stanford_conf import parse_conf
from gnrecon.io.parse import read_text
from gnrecon.io.read import extension_of
from gnrecon.runtime.errors import InputError


def all_input_files(paths: Iterable[Path], format: str | None = None) -> list[Path]:
    """Return the files of scans and all existing files that they refer to, each once; none may be overwritten.

    A file that cannot be parsed refers to none; its reader reports what is wrong with it. `format` is the extension
    that says how the files are read, such as ``"conf"``; by default their own.
    """
    parsers: dict[str, Callable[[Path], Iterable[str]]] = {
        ".conf": lambda scan: [pose.file for pose in parse_conf(read_text(scan))],
        ".gltf": _named_by_gltf,
        ".obj": _named_by_obj,
        ".ply": lambda scan: _words_after(scan, rb"comment[ \t]+TextureFile"),
    }
    found: dict[Path, None] = {}
    for path in paths:
        found[path] = None
        extension = extension_of(path) if format is None else f".{format.lower().removeprefix('.')}"
        # A name may be longer than the system allows, and what a pipe holds can be read only once.
        with suppress(InputError, OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError):
            for name in parsers[extension](path) if extension in parsers and path.is_file() else ():
                if (file := path.parent / name).is_file():
                    found[file] = None
    return list(found)


def _named_by_gltf(path: Path) -> Iterator[str]:
    document = json.loads(path.read_bytes())
    for entry in [*document.get("buffers", []), *document.get("images", [])]:
        uri = str(entry.get("uri", "data:"))
        if not uri.startswith("data:"):
            yield unquote(uri)


def _named_by_obj(path: Path) -> Iterator[str]:
    """Yield materials, which are named in the file's head, and the textures that these name."""
    for material in _words_after(path, rb"mtllib"):
        yield material
        if (path.parent / material).is_file():
            yield from _words_after(path.parent / material, rb"(?:map_\w+|bump|disp|decal|refl|norm)")


def _words_after(path: Path, keyword: bytes, *, head_bytes: int = 1_000_000) -> list[str]:
    """Return what follows a keyword in lines of a file's head: all of it, and each of its words."""
    with path.open("rb") as file:
        head = file.read(head_bytes)
    lines = re.findall(rb"^[ \t]*" + keyword + rb"[ \t]+([^\r\n]*[^\s])", head, re.IGNORECASE | re.MULTILINE)
    words = [word for line in lines for word in (line, *line.split())]
    return [word.decode("utf-8", "surrogateescape") for word in dict.fromkeys(words)]
