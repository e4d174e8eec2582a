"""Ingest: from a cloud as read to oriented samples in the unit ball."""

from gnrecon.ingest.clean import clean, require_mode, without_garbage
from gnrecon.ingest.counts import IngestCounts
from gnrecon.ingest.double_walls import Layers, layers_of
from gnrecon.ingest.ingest_parameters import IngestParameters
from gnrecon.ingest.isolated_clusters import isolated_clusters
from gnrecon.ingest.noise import Noise, estimate_noise
from gnrecon.ingest.normal_agreement import sheet_thickness
from gnrecon.ingest.orientation import flip_if_inward, oriented_normals
from gnrecon.ingest.outliers import find_outliers, parse_outliers
from gnrecon.ingest.point_spacing import mean_spacing
from gnrecon.ingest.prepare import prepare
from gnrecon.ingest.subsample import subsample
from gnrecon.ingest.survey import Survey, is_single_sheet, survey
from gnrecon.ingest.unit_guess import UnitsGuess, guess_units

__all__ = [
    "IngestCounts",
    "IngestParameters",
    "Layers",
    "Noise",
    "Survey",
    "UnitsGuess",
    "clean",
    "estimate_noise",
    "find_outliers",
    "flip_if_inward",
    "guess_units",
    "is_single_sheet",
    "isolated_clusters",
    "layers_of",
    "mean_spacing",
    "oriented_normals",
    "parse_outliers",
    "prepare",
    "require_mode",
    "sheet_thickness",
    "subsample",
    "survey",
    "without_garbage",
]
