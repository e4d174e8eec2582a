"""The numbers that tune pictures: camera, light and layout. Values were chosen by eye on the sample scans."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class LightParameters:
    """Lamps and sky; all are fixed to the camera, so that every view is lit alike. Colours are linear."""

    # Directions to the lamps in the camera's axes (right, up, backward), and their strengths.
    key_direction: tuple[float, float, float] = (-0.65, 0.7, 0.45)
    key_strength: float = 1.45
    fill_direction: tuple[float, float, float] = (0.85, 0.1, 0.35)
    fill_strength: float = 0.28
    # Light from straight above and from straight below.
    sky_color: tuple[float, float, float] = (0.46, 0.52, 0.62)
    ground_color: tuple[float, float, float] = (0.20, 0.17, 0.15)
    # Light that a white surface reflects as white.
    exposure: float = 1.5
    # How near something must be to cover the sky, in halves of the shape's size.
    occlusion_reach: float = 0.7
    # Directions over the whole sphere in which the sky is sampled.
    sky_directions: int = 48


@dataclass(frozen=True)
class SheetParameters:
    """Layout of the contact sheet, in pixels: widths and heights of its rows, and of the labels below each."""

    width: int = 1200
    upper_height: int = 524
    lower_height: int = 364
    label_height: int = 36
    label_size: int = 17
    # sRGB.
    label_color: tuple[int, int, int] = (96, 96, 100)
    # Views of the lower row, from the left.
    lower_views: tuple[str, ...] = ("front", "right", "top")


@dataclass(frozen=True)
class RenderingParameters:
    """All numbers that tune pictures."""

    # Over the picture's shorter side: narrow enough to look undistorted.
    field_of_view_degrees: float = 24.0
    # Samples along each side of a pixel.
    supersampling: int = 3
    light: LightParameters = LightParameters()
    sheet: SheetParameters = SheetParameters()
