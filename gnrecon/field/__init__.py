"""Networks and their derivatives in closed form."""

from gnrecon.field.siren import Siren

__all__ = ["Siren"]
