"""PCD, the Point Cloud Library's format, by open3d's tensor reader.

That reader keeps doubles and all scalar fields (open3d's older one misreads binary doubles). It reports failures by
printing a warning and returning an empty cloud, so the header's count is compared with what arrived.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt

from gnrecon.errors import InputError
from gnrecon.io.contents import Contents, no_faces

_HEADER_BYTES = 65536


def read_pcd(path: Path) -> Contents:
    """Read an ascii, binary or binary_compressed PCD.

    Raises
    ------
    InputError
        When the header is malformed or fewer points than it declares can be read.
    """
    import open3d

    declared = _declared(path)
    with open3d.utility.VerbosityContextManager(open3d.utility.VerbosityLevel.Error):
        cloud = open3d.t.io.read_point_cloud(path, format="pcd")
    arrays: dict[str, npt.NDArray[np.generic]] = {name: cloud.point[name].numpy() for name in cloud.point}
    points = arrays.pop("positions", np.empty((0, 3)))
    if len(points) != declared:
        raise InputError(f"the header declares {declared} points, but {len(points)} could be read.")
    normals = arrays.pop("normals", None)
    columns = {name: values[:, 0] if values.shape[1:] == (1,) else values for name, values in arrays.items()}
    return Contents(
        points.astype(np.float64), None if normals is None else normals.astype(np.float64), no_faces(), columns
    )


def _declared(path: Path) -> int:
    """Return the number of points that the header declares, after checks that keep open3d from misreading it."""
    with path.open("rb") as file:
        head = file.read(_HEADER_BYTES)
    header: dict[str, list[str]] = {}
    for line in head.splitlines():
        words = line.decode("ascii", errors="replace").split()
        if words and not words[0].startswith("#"):
            header[words[0].upper()] = words[1:]
        if "DATA" in header:
            break
    missing = [key for key in ("FIELDS", "SIZE", "TYPE", "WIDTH", "HEIGHT", "DATA") if not header.get(key)]
    if missing:
        raise InputError(f"the PCD header lacks {' and '.join(missing)}.")
    absent = {"x", "y", "z"} - set(header["FIELDS"])
    if absent:
        raise InputError(f"expected fields named x, y and z, but the header lists {' '.join(header['FIELDS'])}.")
    count = (header.get("POINTS") or [str(int(header["WIDTH"][0]) * int(header["HEIGHT"][0]))])[0]
    if not count.isdecimal():
        raise InputError(f"the header declares {count!r} points, but a count was expected.")
    if int(count) > path.stat().st_size * 1000:  # no encoding packs a point that tightly: do not try to allocate it
        raise InputError(f"the header declares {count} points, more than the file can hold.")
    return int(count)
