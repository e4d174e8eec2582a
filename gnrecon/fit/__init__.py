"""From samples to a fitted signed distance field."""

from gnrecon.fit.misfit import Misfit
from gnrecon.fit.options import FitOptions
from gnrecon.fit.scene import bounds_of
from gnrecon.fit.schedule import fit
from gnrecon.fit.sdf import NeuralSDF
from gnrecon.fit.uncertainty import Uncertainty

__all__ = ["FitOptions", "Misfit", "NeuralSDF", "Uncertainty", "bounds_of", "fit"]
