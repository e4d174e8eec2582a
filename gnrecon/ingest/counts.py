"""What ingest did to a cloud, in numbers and in sentences."""

from __future__ import annotations

from dataclasses import asdict, dataclass


@dataclass(frozen=True)
class IngestCounts:
    """Numbers of points, from the file to the fit.

    Parameters
    ----------
    read : points in the file
    non_finite : dropped, because a coordinate was NaN or infinite
    zero_normals : dropped, because they had no direction although most others did
    duplicates : dropped, because another point has exactly the same position
    repeated : dropped, because they are copies of others, of a scan that is there twice
    outliers : dropped as scattered far off the surface
    outliers_found : found so, but left alone because they are too many or because removal is off
    clusters : dropped, because they lie together and off all others
    clusters_found : found so, but left alone for the same reasons
    held_out : kept from the fit, to check it
    moved : root mean square distance by which smoothing moved the points, in file units; None without smoothing
    thinned : left out by subsampling
    kept : what remains
    normals : how they came about, such as ``"given"``, ``"given, flipped"`` or ``"estimated"``
    confidence : share of the points that speak for the side of their normal, see `Orientation`; None where it was given
    flipped : share of the given normals that were turned around
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
        """Return one sentence for everything that was not taken as it came."""
        dropped = {
            "with a coordinate that is not finite": self.non_finite,
            "with a zero or non-finite normal": self.zero_normals,
            "at the position of another": self.duplicates,
            "that repeat another to within rounding, as of a scan that is there twice": self.repeated,
            "scattered far off the surface": self.outliers,
            "in isolated clusters": self.clusters,
        }
        sentences = [f"Dropped {count} of {self.read} points {why}." for why, count in dropped.items() if count]
        if self.outliers_found:
            sentences.append(f"Left {self.outliers_found} points alone that look like outliers.")
        if self.clusters_found:
            sentences.append(f"Left {self.clusters_found} points alone that lie in isolated clusters.")
        if self.moved is not None:
            sentences.append(
                f"Smoothed the points, which moved by {self.moved:.3g} file units in the root mean square."
            )
        if self.normals != "given":
            sentences.append(f"Normals: {self.normals}{self._told()}.")
        return sentences

    def _told(self) -> str:
        turned = f"; {100 * self.flipped:.3g} % turned around" if 0 < self.flipped < 1 else ""
        if self.confidence is None:
            return turned
        return f"{turned}; {100 * self.confidence:.0f} % of the points confirm their side"
