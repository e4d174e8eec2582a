"""What is known of each vertex besides its place, and how it was found."""

from __future__ import annotations

from dataclasses import dataclass

from gnrecon.geometry.arrays import Values


@dataclass(frozen=True)
class Attribute:
    """Values for the vertices of a mesh.

    Parameters
    ----------
    name : str
    values : array of shape (V,) or (V, C)
    origin : str
        How they were found, for the report: no sentence, no stop.
    """

    name: str
    values: Values
    origin: str
