"""From samples to a fitted signed distance field."""

from __future__ import annotations

import inspect
import sys
from types import ModuleType
from typing import Any

from gnrecon.fit.field_model import NeuralSDF
from gnrecon.fit.fit_field import fit
from gnrecon.fit.fit_options import FitOptions
from gnrecon.fit.objective import bounds_of
from gnrecon.fit.posterior.residual_stats import Misfit
from gnrecon.fit.posterior.uncertainty import Uncertainty
from gnrecon.optim import Solution

__all__ = ["FitOptions", "Misfit", "NeuralSDF", "Uncertainty", "bounds_of", "fit"]


class _CallableRoom(ModuleType):
    """This package, called as the function `fit`.

    Python binds ``gnrecon.fit`` to the package as soon as anything imports it, in place of the public function.
    """

    def __call__(self, *arguments: Any, **options: Any) -> tuple[NeuralSDF, Solution]:
        """Return ``fit(*arguments, **options)``."""
        return fit(*arguments, **options)


__signature__ = inspect.signature(fit)
sys.modules[__name__].__class__ = _CallableRoom
