"""From samples to a fitted signed distance field."""

from gnrecon.fit.field_model import NeuralSDF
from gnrecon.fit.fit_field import fit
from gnrecon.fit.fit_options import FitOptions
from gnrecon.fit.objective import bounds_of
from gnrecon.fit.posterior.uncertainty import Uncertainty
from gnrecon.fit.residual_stats import Misfit

__all__ = ["FitOptions", "Misfit", "NeuralSDF", "Uncertainty", "bounds_of", "fit"]
