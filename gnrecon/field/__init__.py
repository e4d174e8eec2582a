"""Networks and their derivatives in closed form."""

from gnrecon.field.jacobian_rows import CurvedJet
from gnrecon.field.layers import ACTIVATIONS, SINE, TANH, WAVELET, Activation
from gnrecon.field.networks import Network, Siren

__all__ = ["ACTIVATIONS", "SINE", "TANH", "WAVELET", "Activation", "CurvedJet", "Network", "Siren"]
