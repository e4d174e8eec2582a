"""Sets of local changes that do not touch each other, so that arrays can make all of them at once.

Every candidate has a rank and a set of vertices. It is chosen when it has the lowest rank of all candidates on each of
its vertices: chosen candidates share no vertex then, and as the lowest rank of all is always chosen, rounds end.
"""

from __future__ import annotations

import numpy as np

from gnrecon.geometry.arrays import Float, Int, Mask


def ranks(order_by: Float) -> Int:
    """Ranks from 0 of values of shape (N,), ties in their order."""
    rank = np.empty(len(order_by), dtype=np.int64)
    rank[np.argsort(order_by, kind="stable")] = np.arange(len(order_by))
    return rank


def apart(members: Int, rank: Int, count: int) -> Mask:
    """Which candidates, with vertices `members` of shape (N, K) among `count`, share no vertex with a lower rank."""
    best = np.full(count, len(rank), dtype=np.int64)
    for column in members.T:
        np.minimum.at(best, column, rank)
    chosen: Mask = (best[members] == rank[:, None]).all(axis=1)
    return chosen


def rings_apart(members: Int, rank: Int, faces: Int, count: int) -> Mask:
    """Which candidates, with vertices `members` of shape (N, K), touch no face that one of lower rank touches."""
    best = np.full(count, len(rank), dtype=np.int64)
    for column in members.T:
        np.minimum.at(best, column, rank)
    around = best[faces].min(axis=1)
    seen = np.full(count, len(rank), dtype=np.int64)
    for corner in faces.T:
        np.minimum.at(seen, corner, around)
    chosen: Mask = (seen[members] == rank[:, None]).all(axis=1)
    return chosen
