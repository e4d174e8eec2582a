"""Pictures of meshes and clouds, by ray casting on the CPU, without a display."""

from gnrecon.rendering.picture import render, render_sheet
from gnrecon.rendering.rays import vertex_ambient_occlusion

__all__ = ["render", "render_sheet", "vertex_ambient_occlusion"]
