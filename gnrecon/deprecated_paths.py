"""Import paths of gnrecon 0.1, which work in 0.2 with a DeprecationWarning and end with 0.3.

Each old module is found by a finder at the end of `sys.meta_path`, so that other imports cost nothing. What it gives is
a module that looks every name up where it is now.
"""

from __future__ import annotations

import sys
import warnings
from collections.abc import Sequence
from importlib import import_module
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from pathlib import Path
from types import FrameType, ModuleType
from typing import Any

MOVED = {
    "gnrecon.cloud": "gnrecon.geometry.point_cloud",
    "gnrecon.design": "gnrecon.shape_learning.design",
    "gnrecon.errors": "gnrecon.runtime.errors",
    "gnrecon.levelset": "gnrecon.level_set",
    "gnrecon.linalg": "gnrecon.least_squares",
    "gnrecon.mesh": "gnrecon.geometry.mesh",
    "gnrecon.page": "gnrecon.report.html",
    "gnrecon.sampling": "gnrecon.geometry.signed_distance",
    "gnrecon.schema": "gnrecon.report.report",
    "gnrecon.settings": "gnrecon.config",
    "gnrecon.shapes": "gnrecon.shape_learning",
    "gnrecon.shaping": "gnrecon.solid",
}
"""Where the documented modules of 0.1 are now."""


class MovedModules(MetaPathFinder, Loader):
    """Finds modules by their old paths."""

    def find_spec(
        self, fullname: str, path: Sequence[str] | None = None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        """Return how an old path is loaded; None for every other."""
        del path, target
        return ModuleSpec(fullname, self) if fullname in MOVED else None

    def exec_module(self, module: ModuleType) -> None:
        """Fill an old module: each of its names is looked up in the new one."""
        new = import_module(MOVED[module.__name__])
        warnings.warn(
            f"{module.__name__} is {new.__name__} since gnrecon 0.2, and the old path ends with 0.3.",
            DeprecationWarning,
            stacklevel=_frames_to_caller(),
        )

        def look_up(name: str) -> Any:
            return getattr(new, name)

        module.__dict__.update(__doc__=new.__doc__, __getattr__=look_up, __all__=list(public_names(new)))


def _frames_to_caller() -> int:
    """Return how far up the caller's frame is whose line imports an old path: beyond importlib's and gnrecon's own."""
    own = (str(Path(__file__).parent / "__init__.py"), __file__)
    frame: FrameType | None = sys._getframe(1)
    level = 1
    while frame is not None and (frame.f_code.co_filename in own or "importlib" in frame.f_code.co_filename):
        # `warnings.warn` itself does not count the frames of importlib's frozen core.
        level += "importlib._bootstrap" not in frame.f_code.co_filename
        frame = frame.f_back
    return level


def public_names(module: ModuleType) -> Sequence[str]:
    """Return what ``from module import *`` takes."""
    names: Sequence[str] = getattr(module, "__all__", [name for name in vars(module) if not name.startswith("_")])
    return names


def install() -> None:
    """Let old paths be found, once."""
    if not any(isinstance(finder, MovedModules) for finder in sys.meta_path):
        sys.meta_path.append(MovedModules())
