"""Imports the heavy libraries in the parent process, so that forked processes do not have to."""

from __future__ import annotations

from gnrecon.runtime.quiet_imports import import_uninterrupted


def preload() -> None:
    """Import all libraries that most runs need."""
    import open3d  # noqa: F401
    import pandas  # noqa: F401
    import PIL.Image  # noqa: F401
    import threadpoolctl  # noqa: F401
    from skimage.measure import marching_cubes  # noqa: F401 - its module is loaded by its name

    import_uninterrupted("trimesh")  # and manifold3d
