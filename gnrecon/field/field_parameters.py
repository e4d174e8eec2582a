"""Parameters of the field's representation: the spectrum of random features, and the sizes of batches."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class FieldParameters:
    """Shared by the random features and their partition of unity."""

    # Degrees of freedom of the Student t distribution of the frequencies: 4 gives a Matern kernel, more a smoother one.
    degrees_of_freedom: float = 12.0
    # Pairs of a point and a cube whose features are computed at once; they fit into the processor's cache.
    batch_pairs: int = 512
    # The same on a GPU, which many small batches leave idle.
    gpu_batch_pairs: int = 32_768
    # Points that one thread evaluates at a time.
    batch_points: int = 16_384
    # The same for values at offsets around centres, which take less memory each.
    batch_stencil_values: int = 131_072
