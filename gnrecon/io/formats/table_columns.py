"""Which columns of a table hold what: by the user's names, or by what the numbers look like.

Too few columns, and names that do not fit, end in an `InputError`.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from gnrecon.geometry.arrays import Float, Values
from gnrecon.io.column_names import COLOR, NORMAL, POSITION, require_position
from gnrecon.runtime.errors import InputError


def named_by_user(columns: Sequence[str], width: int) -> list[str]:
    """Return the names of `width` columns after those that the user gave; ``-`` and missing ones are not read."""
    if len(columns) > width:
        raise InputError(f"--columns names {len(columns)} columns, but the rows hold {width}.")
    names = ["" if name.strip() == "-" else name.strip() for name in columns]
    require_position([name for name in names if name], " Name each column in order, with - for those to skip.")
    return names + [""] * (width - len(names))


def guessed(rows: Float, places: Sequence[int], suffix: str = "") -> tuple[list[str], tuple[str, ...]]:
    """Return names for the columns of a table without a header, and sentences on what was guessed.

    Parameters
    ----------
    rows : array of shape (N, C), the columns that hold numbers
    places : of these columns among all of the file's, from 0
    suffix : extension of the file; points of ``.pts`` have their intensity before their colour
    """
    names: list[str] = ["index"] if _is_index(rows) else ["row", "column"] if _are_cells(rows) else []
    reasons = {"nx": "unit length"}
    if rows.shape[1] - len(names) < 3:
        raise InputError(f"expected at least 3 columns (x, y, z), but found {rows.shape[1] - len(names)}.")
    first = rows[:, len(names) :]
    grows = first.shape[1] > 3 and _grows(first[:, 0])
    if _are_normals_first(first):
        names += NORMAL
    elif _is_before_position(first):
        names.append("time" if grows else "intensity")
    elif grows:
        reasons["x"] = f"column {places[len(names)] + 1} grows, as a time would"
    names += POSITION
    while (at := len(names)) < rows.shape[1]:
        group, reason = _group(rows[:, at:], names, suffix)
        names += group
        reasons |= {group[0]: reason}
    singles = [at for at, name in enumerate(names) if not name]
    names = [name or f"column_{places[at] + 1}" for at, name in enumerate(names)]
    if len(singles) == 1 and "intensity" not in names:
        names[singles[0]] = "intensity"
    return names, _sentences(names, reasons, places)


def _sentences(names: list[str], reasons: dict[str, str], places: Sequence[int]) -> tuple[str, ...]:
    """One sentence on what was guessed; none where the first three columns are all that there is."""
    spoken = {"index": "a running number"} | {name: name for name in ("time", "intensity", "row", "column")}
    of_three = {"x": "x, y, z", "nx": "normals", "red": "colours"}
    found, values = [], []
    for at, name in enumerate(names):
        if name.startswith("column_"):
            values.append(f"{places[at] + 1}")
        if name in spoken or (name in of_three and (name != "x" or places[at] or reasons.get("x"))):
            first = places[at] + 1
            which = f"column {first} is" if name in spoken else f"columns {first} to {places[at + 2] + 1} are"
            reason = f" ({reasons[name]})" if reasons.get(name) else ""
            found.append(f"{which} taken for {(spoken | of_three)[name]}{reason}")
    found += [f"values without a name are in column {', '.join(values)}"] if values else []
    return (f"The table has no header: {', '.join(found)}; --columns says otherwise.",) if found else ()


def _group(rest: Float, names: list[str], suffix: str) -> tuple[list[str], str]:
    """Return the names of the next columns, and why: three of a normal or a colour, or one without a name."""
    unit = rest.shape[1] >= 3 and _are_normals(rest[:, :3])
    if "nx" not in names and (unit or (suffix == ".xyzn" and rest.shape[1] >= 3)):
        return list(NORMAL), "unit length" if unit else ""
    if "red" in names or rest.shape[1] < 3 or not _are_colors(rest[:, :3]):
        return [""], ""
    four = rest.shape[1] >= 4 and _are_colors(rest[:, 1:4])
    # Four columns that all may be bytes: scanners write the intensity first in PTS, and after the colour elsewhere. One
    # that never changes, or alone exceeds 255, is no colour channel.
    if four:
        odd = [bool(np.ptp(rest[:, end]) == 0 or rest[:, end].max() > 255 >= rest[:, 1:3].max()) for end in (0, 3)]
        if odd[0] > odd[1] or (odd[0] == odd[1] and suffix == ".pts"):
            return [""], ""
    top = rest[:, :3].max(initial=0)
    return list(COLOR), f"0 to {1 if top <= 1 else 255 if top <= 255 else 65535}"


def _is_index(rows: Float, *, least_rows: int = 10) -> bool:
    """Whether the first of at least four columns numbers the rows in even steps, while others hold fractions."""
    if rows.shape[1] < 4 or len(rows) < least_rows or (rows[:, 0] % 1 != 0).any():
        return False
    steps = np.diff(rows[:, 0])
    return bool((rows[:, 1:4] % 1 != 0).any() and steps[0] > 0 and np.ptp(steps) == 0)


def _are_cells(rows: Float) -> bool:
    """Whether the first two of at least five columns are the cells of a grid, as FARO's scanners write them."""
    cells, digits = rows[:, :2], [_digits(column) for column in rows[:2000, :5].T]
    fit = len(digits) == 5 and max(digits[:2]) == 0 < min(digits[2:]) == max(digits[2:])
    ordered = fit and cells.min() >= 0 and (_grows(cells[:, 0]) or _grows(cells[:, 1]))
    return bool(ordered and not _are_normals(rows[:, 3:6]) and len(np.unique(cells, axis=0)) == len(cells))


def _are_normals_first(rows: Float) -> bool:
    """Whether the first three of at least six columns are normals, and the next three neither normals nor colours."""
    next_three = rows[:, 3:6]
    return (
        rows.shape[1] >= 6 and _are_normals(rows[:, :3]) and not (_are_normals(next_three) or _are_colors(next_three))
    )


def _grows(values: Float) -> bool:
    """Whether numbers, of shape (N,), never decrease, as times in the order of measuring."""
    return bool((np.diff(values) >= 0).all() and values[-1] > values[0])


def _is_before_position(
    rows: Float, *, least_rows: int = 50, most_rows: int = 2000, least_share: float = 0.1, most_thickness: float = 0.05
) -> bool:
    """Whether x, y, z are not the first three columns but the next ones, after a time or an intensity.

    They are so where the next three lie on a surface and the first three do not, and the first column grows from row to
    row or holds whole numbers before fractions. Where both do, as (time, x, y) of a scanner that moves evenly, a column
    that grows is a time if it is written with other digits than the three, or in even steps, or is far beyond them, as
    seconds since 1970 are.

    Parameters
    ----------
    rows : array of shape (N, C)
    least_rows, most_rows : fewer rows show no surface; of more, so many are looked at
    least_share : of the values of x and y that differ, as many must differ in z: a class or a flag has few
    most_thickness : of a surface, see `_thickness`; points that fill a volume have 0.15
    """
    rows = rows[np.isfinite(rows).all(axis=1)]
    if rows.shape[1] < 4 or len(rows) < least_rows or _grows(rows[:, 3]) or _are_normals(rows[:, 3:6]):
        return False
    if _grows(rows[:, 0]) and rows[:, 0].min() > max(1e8, 30 * np.abs(rows[:, 1:4]).max()):
        return True
    chosen = np.random.default_rng(0).permutation(len(rows))[:most_rows]
    sample, next_three = rows[chosen, :4], rows[chosen, 1:4]
    different, digits = [len(np.unique(column)) for column in sample.T], [_digits(column) for column in sample.T]
    grows, thickness = _grows(rows[:, 0]), _thickness(next_three)
    if different[3] < least_share * min(different[1:3]) or thickness > most_thickness:
        return False
    if _thickness(sample[:, :3]) > max(most_thickness, 3 * thickness):
        return grows or digits[0] == 0 < min(digits[1:])
    # A coordinate that grows repeats in the rows of a grid or of a profile.
    if not grows or different[0] < len(sample) / 2:
        return False
    steps = np.diff(rows[:, 0])
    even = bool(np.quantile(steps, 0.99) <= 2 * np.median(steps))
    return even or digits[0] != digits[1] == digits[2] == digits[3]


def _thickness(points: Float, *, neighbors: int = 12) -> float:
    """How far points, of shape (N, 3), are from a surface, in whatever units each coordinate is measured.

    It is the median share of the least of three variances among neighbours, after each coordinate is scaled to the same
    spread: 0 on a plane, 1/3 where no direction differs.
    """
    from scipy.spatial import cKDTree

    spread = np.std(points, axis=0)
    scaled = (points - points.mean(axis=0)) / np.where(spread > 0, spread, 1)
    near = scaled[cKDTree(scaled).query(scaled, neighbors)[1]]
    offsets = near - near.mean(axis=1, keepdims=True)
    variances = np.linalg.eigvalsh(np.einsum("nki,nkj->nij", offsets, offsets))
    return float(np.median(variances[:, 0] / np.maximum(variances.sum(axis=1), np.finfo(np.float64).tiny)))


def _digits(values: Float, *, most: int = 9) -> int:
    """How many digits after the decimal mark the numbers, of shape (N,), were written with."""
    rounding = 4 * np.finfo(np.float64).eps * np.abs(values)
    return next((n for n in range(most) if (np.abs(np.round(values, n) - values) <= rounding).all()), most)


def _are_normals(vectors: Float, *, least_share: float = 0.9, tolerance: float = 0.05) -> bool:
    """Whether at least a share of the finite non-zero rows, of shape (N, 3), have unit length.

    The tolerance of the length is wide because some scanners store normals with two digits.
    """
    lengths = np.linalg.norm(vectors, axis=1)
    lengths = lengths[np.isfinite(lengths) & (lengths > 0)]
    return len(lengths) > 0 and bool((np.abs(lengths - 1) < tolerance).mean() >= least_share)


def _are_colors(values: Values) -> bool:
    """Whether all numbers, of shape (N, 3), are whole ones from 0 to 255 or 65535, or shares from 0 to 1; not all 0."""
    finite = values[np.isfinite(values)]
    if not finite.any() or finite.min() < 0:
        return False
    return bool(finite.max() <= 1) or bool(finite.max() <= 65535 and (finite == np.rint(finite)).all())
