"""Importing the heavy libraries ahead of their use, so that processes that are forked later need not."""

from __future__ import annotations


def preload() -> None:
    """Import every library that most runs come to."""
    import manifold3d  # noqa: F401
    import open3d  # noqa: F401
    import PIL.Image  # noqa: F401
    import skimage.measure  # noqa: F401
    import trimesh  # noqa: F401
