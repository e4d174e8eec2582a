"""From a cloud as read to samples in the unit ball: cleaning, orientation, thinning."""

from gnrecon.ingest.clean import clean, isolated_clusters, require_mode
from gnrecon.ingest.counts import IngestCounts
from gnrecon.ingest.noise import Noise, estimate_noise, mean_spacing
from gnrecon.ingest.orientation import flip_if_inward, oriented_normals
from gnrecon.ingest.outliers import find_outliers, parse_outliers
from gnrecon.ingest.prepare import prepare
from gnrecon.ingest.subsample import subsample
from gnrecon.ingest.survey import Layers, Survey, UnitsGuess, guess_units, layers_of, survey

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
