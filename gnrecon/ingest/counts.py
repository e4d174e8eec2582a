"""Numbers of points that ingest dropped and changed, and the remarks about them."""

from __future__ import annotations

from dataclasses import asdict, dataclass


@dataclass(frozen=True)
class IngestCounts:
    """Numbers of points, from the file to the fit.

    Parameters
    ----------
    read : points in the file
    non_finite : dropped, because a coordinate was NaN, infinite or out of all proportion
    zero_normals : dropped, because they had no direction although most others did
    duplicates : dropped, because another point has exactly the same position
    repeated : dropped, because they are copies of others, as where a scan is contained twice
    outliers : dropped, because they are scattered far off the surface
    outliers_found : outliers that were kept, because they are too many or because removal is off
    clusters : dropped, because they are in isolated clusters
    clusters_found : points in isolated clusters that were kept, for the same reasons
    inner : dropped, because they fill the volume below its surface
    along_lines : dropped, because they lie closer along lines than anything is known between the lines
    half_line_distance : about half of the distance of the lines, in file units; None elsewhere
    arrangement : ``"lines"`` or ``"volume"`` where the points lie along lines or fill a volume; None on surfaces
    held_out : validation points, which the fit does not use
    moved : root mean square distance by which smoothing moved the points, in file units; None without smoothing
    thinned : dropped by subsampling
    kept : number of remaining points
    normals : their origin, such as ``"given"``, ``"given, flipped"`` or ``"estimated"``
    confidence : share of the points that confirm the sign of their normal, see `Orientation`; None for given signs
    flipped : share of the given normals that were flipped
    """

    read: int
    non_finite: int = 0
    zero_normals: int = 0
    duplicates: int = 0
    repeated: int = 0
    outliers: int = 0
    outliers_found: int = 0
    clusters: int = 0
    clusters_found: int = 0
    inner: int = 0
    along_lines: int = 0
    half_line_distance: float | None = None
    arrangement: str | None = None
    held_out: int = 0
    moved: float | None = None
    thinned: int = 0
    kept: int = 0
    normals: str = "missing"
    confidence: float | None = None
    flipped: float = 0.0

    def as_dict(self) -> dict[str, int | float | str | None]:
        """Return the fields by name, for reports."""
        return asdict(self)

    def remarks(self) -> list[str]:
        """Return a sentence for each change."""
        dropped = {
            "with a coordinate that is not finite or out of all proportion": self.non_finite,
            "with a zero or non-finite normal": self.zero_normals,
            "that duplicate another": self.duplicates,
            "that repeat another to within rounding": self.repeated,
            "scattered far off the surface": self.outliers,
            "in isolated clusters": self.clusters,
        }
        sentences = [f"Dropped {count} of {self.read} points {why}." for why, count in dropped.items() if count]
        if self.outliers_found:
            sentences.append(f"Kept {self.outliers_found} points that look like outliers.")
        if self.clusters_found:
            sentences.append(f"Kept {self.clusters_found} points in isolated clusters.")
        if self.arrangement == "lines":
            left_out = f" Left out {self.along_lines} points along the lines." if self.along_lines else ""
            sentences.append(
                "The points lie along lines that are far apart for the distance of points on a line; what is between "
                f"the lines is interpolated.{left_out}"
            )
        if self.arrangement == "volume":
            what = f" Kept its outer surface, without {self.inner} points below it." if self.inner else ""
            sentences.append(f"The points fill a volume instead of lying on its surface.{what}")
        if self.moved is not None:
            sentences.append(f"Smoothed the points; they moved by {self.moved:.3g} file units (root mean square).")
        if self.normals != "given":
            sentences.append(f"Normals: {self.normals}{self._sign_remark()}.")
        return sentences

    def _sign_remark(self) -> str:
        """Return how the signs were found, to follow the origin of the normals."""
        flipped = f"; {100 * self.flipped:.3g} % flipped" if 0 < self.flipped < 1 else ""
        if self.confidence is None:
            return flipped
        return f"{flipped}; {100 * self.confidence:.0f} % of the points confirm their sign"
