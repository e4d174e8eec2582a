"""Which files a scan consists of: its own, and those that its own names."""

from __future__ import annotations

import json
from pathlib import Path
from urllib.parse import unquote

from gnrecon.errors import InputError
from gnrecon.io.beside import beside
from gnrecon.io.conf import parse_conf
from gnrecon.io.text import read_text
from gnrecon.io.unpack import extension_of


def members(path: Path) -> list[Path]:
    """Return a scan's file and all that it names and that are there, each once.

    A file that cannot be understood names none: what is wrong with it, its reader will say.
    """
    try:
        named = _NAMES.get(extension_of(path), lambda _: [])(path)
        there = [beside(path.parent, name, "file") for name in named]
    except (InputError, ValueError, KeyError, TypeError, AttributeError):
        there = []
    return list(dict.fromkeys([path, *(member for member in there if member.is_file())]))


def _of_conf(path: Path) -> list[str]:
    return [pose.file for pose in parse_conf(read_text(path))]


def _of_gltf(path: Path) -> list[str]:
    uris = [str(one["uri"]) for one in json.loads(path.read_bytes()).get("buffers", [])]
    return [unquote(uri) for uri in uris if not uri.startswith("data:")]


_NAMES = {".conf": _of_conf, ".gltf": _of_gltf}
