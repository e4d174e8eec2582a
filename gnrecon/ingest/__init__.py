"""From a cloud as read to samples in the unit ball: cleaning, orientation, thinning."""

from gnrecon.ingest.clean import clean, require_mode
from gnrecon.ingest.clusters import isolated_clusters
from gnrecon.ingest.counts import IngestCounts
from gnrecon.ingest.layers import Layers, layers_of
from gnrecon.ingest.noise import Noise, estimate_noise
from gnrecon.ingest.normals import flip_if_inward, oriented_normals
from gnrecon.ingest.outlier_rules import parse_outliers
from gnrecon.ingest.outliers import find_outliers
from gnrecon.ingest.prepare import prepare
from gnrecon.ingest.spacing import mean_spacing
from gnrecon.ingest.subsample import subsample
from gnrecon.ingest.survey import Survey, survey
from gnrecon.ingest.units import UnitsGuess, guess_units

__all__ = [
    "IngestCounts",
    "Layers",
    "Noise",
    "Survey",
    "UnitsGuess",
    "clean",
    "estimate_noise",
    "find_outliers",
    "flip_if_inward",
    "guess_units",
    "isolated_clusters",
    "layers_of",
    "mean_spacing",
    "oriented_normals",
    "parse_outliers",
    "prepare",
    "require_mode",
    "subsample",
    "survey",
]
