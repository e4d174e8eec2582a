"""Networks and their derivatives in closed form."""

from gnrecon.field.activation import ACTIVATIONS, SINE, TANH, WAVELET, Activation
from gnrecon.field.curved_jet import CurvedJet
from gnrecon.field.network import Network
from gnrecon.field.siren import Siren

__all__ = ["ACTIVATIONS", "SINE", "TANH", "WAVELET", "Activation", "CurvedJet", "Network", "Siren"]
