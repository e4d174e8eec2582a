"""From a cloud as read to samples in the unit ball: cleaning, orientation, thinning."""

from gnrecon.ingest.clean import clean, require_mode
from gnrecon.ingest.clusters import isolated_clusters
from gnrecon.ingest.counts import IngestCounts
from gnrecon.ingest.normals import flip_if_inward, oriented_normals
from gnrecon.ingest.outlier_rules import parse_outliers
from gnrecon.ingest.outliers import find_outliers
from gnrecon.ingest.prepare import prepare
from gnrecon.ingest.spacing import mean_spacing
from gnrecon.ingest.subsample import subsample

__all__ = [
    "IngestCounts",
    "clean",
    "find_outliers",
    "flip_if_inward",
    "isolated_clusters",
    "mean_spacing",
    "oriented_normals",
    "parse_outliers",
    "prepare",
    "require_mode",
    "subsample",
]
