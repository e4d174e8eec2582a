"""From a cloud as read to samples in the unit ball: cleaning, orientation, thinning."""

from gnrecon.ingest.clean import clean
from gnrecon.ingest.counts import IngestCounts
from gnrecon.ingest.normals import flip_if_inward, oriented_normals
from gnrecon.ingest.outliers import find_outliers
from gnrecon.ingest.prepare import prepare
from gnrecon.ingest.spacing import mean_spacing
from gnrecon.ingest.subsample import subsample

__all__ = [
    "IngestCounts",
    "clean",
    "find_outliers",
    "flip_if_inward",
    "mean_spacing",
    "oriented_normals",
    "prepare",
    "subsample",
]
