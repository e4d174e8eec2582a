"""Design problems: a region that a part must stay within, and the interfaces that it must be attached to."""

from gnrecon.design.design import Design, read_design
from gnrecon.design.interfaces import Interfaces, InterfaceSample
from gnrecon.design.measure import DesignFacts, judge
from gnrecon.design.region import DesignRegion

__all__ = ["Design", "DesignFacts", "DesignRegion", "InterfaceSample", "Interfaces", "judge", "read_design"]
