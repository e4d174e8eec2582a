"""Normals that gnrecon estimates, beside the true ones and open3d's."""
