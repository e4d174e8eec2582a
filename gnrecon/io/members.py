"""Which files a scan consists of: its own, and those that its own names."""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path
from urllib.parse import unquote

from gnrecon.io.beside import beside
from gnrecon.io.conf import parse_conf
from gnrecon.io.text import read_text
from gnrecon.io.unpack import extension_of
from gnrecon.runtime.errors import InputError


def members(path: Path, format: str | None = None) -> list[Path]:
    """Return a scan's file and all files that it names and that exist, each once.

    A file that cannot be parsed names none: its reader reports what is wrong with it.

    Parameters
    ----------
    path : the scan's file
    format : extension that says how the file is read, such as ``"conf"``; by default its own
    """
    extension = extension_of(path) if format is None else f".{format.lower().removeprefix('.')}"
    try:
        named = _NAMES.get(extension, lambda _: [])(path)
        there = [beside(path.parent, name, "file") for name in named]
    except (InputError, OSError, ValueError, KeyError, TypeError, AttributeError):
        there = []
    return list(dict.fromkeys([path, *(member for member in there if member.is_file())]))


def all_members(paths: Iterable[Path], format: str | None = None) -> list[Path]:
    """Return all files that scans are read from, see `members`: none of them may be written."""
    return [member for path in paths for member in members(path, format)]


def _of_conf(path: Path) -> list[str]:
    return [pose.file for pose in parse_conf(read_text(path))]


def _of_gltf(path: Path) -> list[str]:
    uris = [str(one["uri"]) for one in json.loads(path.read_bytes()).get("buffers", [])]
    return [unquote(uri) for uri in uris if not uri.startswith("data:")]


_NAMES = {".conf": _of_conf, ".gltf": _of_gltf}
