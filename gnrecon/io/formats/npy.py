"""NPY and NPZ, numpy's own files: an array of points with their columns, or arrays by name, as users of Python save."""

from __future__ import annotations

import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from gnrecon.geometry.arrays import Values
from gnrecon.io.column_names import POSITION, columns_of_role
from gnrecon.io.contents import Contents, from_columns, guard_parser
from gnrecon.io.formats.table_columns import guessed, named_by_user
from gnrecon.runtime.errors import InputError


def read_npy(path: Path, columns: Sequence[str] = ()) -> Contents:
    """Read an array of shape (N, C) with C of at least 3, a structured array, or an archive of arrays.

    Of an archive, the only array is read, or the one named points, xyz, positions, coords, vertices, pc, pos or data,
    with those named normals and colors, and all other numbers of one row for each point. Pickled objects are never
    loaded. `columns` are the names of the columns where the user gives them.
    """
    with guard_parser("NPY or NPZ"):
        arrays = _arrays(path)
    if columns_of_role(arrays, POSITION):
        return from_columns({name: values for name, values in arrays.items() if values.ndim == 1})
    found = {name.lower(): name for name in arrays}
    usual = ["points", "xyz", "positions", "coords", "vertices", "pc", "pos", "data"]
    usual += found if len(found) == 1 else []
    if (chosen := next((found[name] for name in usual if name in found), None)) is None:
        raise InputError(f"it holds the arrays {', '.join(arrays)[:200]}, but none named points; name them so.")
    cloud = _cloud(arrays[chosen], columns)
    others = {name: one for name, one in arrays.items() if name != chosen and one.dtype.kind in "biuf"}
    rest = {name: one for name, one in others.items() if one.ndim in (1, 2) and len(one) == len(cloud.points)}
    more = from_columns(rest, None, cloud.points)
    unread = [f"the array {name}" for name in arrays if name != chosen and name not in rest]
    return replace(
        cloud,
        normals=cloud.normals if more.normals is None else more.normals,
        attributes={**cloud.attributes, **more.attributes},
        unread=(*cloud.unread, *unread, *more.unread),
    )


def _arrays(path: Path, *, largest_ratio: int = 1032) -> Mapping[str, Values]:
    """Return the arrays by name; what deflates by more than `largest_ratio`, its limit, is damaged."""
    with path.open("rb") as file:
        if file.read(2) == b"PK":
            with zipfile.ZipFile(file) as archive:
                if sum(entry.file_size for entry in archive.infolist()) > largest_ratio * path.stat().st_size:
                    raise InputError("the archive declares more than it can hold.")
            file.seek(0)
            with np.load(file, allow_pickle=False) as loaded:
                return {name: loaded[name] for name in loaded.files}
    # Mapped, so that a damaged header cannot ask for more than the file holds.
    values: Any = np.array(np.load(path, mmap_mode="r", allow_pickle=False))
    records = values.ravel()
    return {name: records[name] for name in values.dtype.names} if values.dtype.names else {"points": values}


def _cloud(values: Values, columns: Sequence[str]) -> Contents:
    if values.dtype.kind not in "iuf" or values.ndim < 2:
        what = f"{values.dtype} of {values.shape}"
        raise InputError(f"expected numbers of shape (N, 3) or more columns, but found {what}.")
    table = values.reshape(-1, values.shape[-1])
    if table.shape[1] > 64 or (values.ndim == 2 and values.shape[0] == 3 < values.shape[1]):
        raise InputError(f"expected rows of points, but found an array of shape {values.shape}; transpose it.")
    numbers, width = table.astype(np.float64), table.shape[1]
    names, remarks = (named_by_user(columns, width), ()) if columns else guessed(numbers, range(width))
    named = {name: numbers[:, place] for place, name in enumerate(names) if name not in ("", "index")}
    return replace(from_columns(named), remarks=remarks)
