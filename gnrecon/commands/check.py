"""``gnrecon check MESH``: whether any mesh bounds a solid, and what is unusual about it."""

from __future__ import annotations

import json
import math
from pathlib import Path

from gnrecon.export import verify as examine
from gnrecon.io import read_mesh
from gnrecon.runtime.errors import ExitCode, MeshError


def check(path: Path, *, as_json: bool = False) -> int:
    """Print what a mesh is, as text or as one JSON object, and return the exit code 0 where it bounds a solid.

    Raises
    ------
    InputError
        When the file cannot be read or holds no faces.
    MeshError
        When the mesh does not bound a solid, after printing; the sentence names everything that is wrong.
    """
    findings = examine(read_mesh(path))
    if as_json:
        # JSON knows no numbers that are not finite, such as the volume of a mesh with broken vertices.
        values = {name: _plain(value) for name, value in findings.as_dict().items()}
        print(json.dumps({"file": str(path), **values}, indent=2))
    else:
        print("\n".join(findings.describe()))
    if not findings.sound:
        raise MeshError(f"{path} does not bound a solid: it {'; it '.join(findings.failures)}.")
    return ExitCode.OK


def _plain(value: object) -> object:
    return None if isinstance(value, float) and not math.isfinite(value) else value
