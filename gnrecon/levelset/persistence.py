"""Which components a solid {f < 0} has within a region, and at which values of f they would join.

As the level t rises, the components of {f < t} are born at minima of f and die where they meet an older one, at
saddles. Zero-dimensional persistent homology pairs the two. On the nodes of a grid, joined along its edges, that is
the persistence of a cubical filtration, which gudhi computes; nodes outside of the region count as infinite, so that no
way leads through them. A pair with

    birth < 0 < death

is a component of the solid that is not connected to the others: it dies at the lowest pass on any way to an older one.

Sources: Edelsbrunner and Harer, Computational Topology (2010); Wagner, Chen and Vucini, Efficient computation of
persistent homology for cubical data (2012). The paper and Berzins et al., Geometry-informed neural networks (2024), use
it for connectedness.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from gnrecon.geometry.arrays import Float, Int


class Separate(NamedTuple):
    """Components of {f < 0} that are not connected to an older one, which is the one with the lower minimum.

    Parameters
    ----------
    births : node of the minimum of each, of shape (K, 3)
    deaths : node of the pass at which each would join an older one, of shape (K, 3)
    islands : node of the minimum, (L, 3), of each that no way within the region joins to any; the first is the oldest
    """

    births: Int
    deaths: Int
    islands: Int

    @property
    def components(self) -> int:
        """Number of components of the solid."""
        return len(self.births) + len(self.islands)


def separate_components(values: Float) -> Separate:
    """Find the components of {f < 0} on a grid, of shape (I, J, K), infinite outside of the region."""
    import gudhi
    from scipy.ndimage import label

    if label(values < 0)[1] == 1:
        # Nothing is apart, which labelling tells a hundred times sooner than persistence.
        none = np.zeros((0, 3), np.int64)
        return Separate(none, none, np.argwhere(values == values.min())[:1])
    filtration = gudhi.CubicalComplex(vertices=values)
    filtration.compute_persistence(min_persistence=0.0)
    paired, essential = filtration.vertices_of_persistence_pairs()
    # The lists have an entry for each dimension that occurs; components are of dimension zero.
    births, deaths = _nodes(paired[:1], values.shape).reshape(-1, 2, 3).swapaxes(0, 1)
    islands = _nodes(essential[:1], values.shape).reshape(-1, 3)
    apart = (_at(values, births) < 0) & (_at(values, deaths) >= 0) & np.isfinite(_at(values, deaths))
    lost = (_at(values, births) < 0) & ~np.isfinite(_at(values, deaths))
    islands = np.concatenate([islands[_at(values, islands) < 0], births[lost]])
    return Separate(births[apart], deaths[apart], islands[np.argsort(_at(values, islands), kind="stable")])


def _nodes(numbers: list[Int], shape: tuple[int, ...]) -> Int:
    """Return the nodes, of shape (..., 3), that gudhi's numbers stand for, in which the first axis runs fastest."""
    flat = np.concatenate([np.zeros((0,), np.int64), *(part.ravel() for part in numbers)])
    return np.stack(np.unravel_index(flat, shape, order="F"), axis=-1)


def _at(values: Float, nodes: Int) -> Float:
    found: Float = values[tuple(nodes.T)]
    return found
