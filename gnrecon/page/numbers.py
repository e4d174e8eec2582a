"""Numbers as a reader wants them: few digits, thousands set apart, a true minus sign."""

from __future__ import annotations

import math

MINUS, TIMES = "\N{MINUS SIGN}", "\N{MULTIPLICATION SIGN}"
_RAISED = str.maketrans("0123456789-", "⁰¹²³⁴⁵⁶⁷⁸⁹⁻")


def count(number: float) -> str:
    """Return a whole number with its thousands set apart."""
    return f"{round(number):,}".replace("-", MINUS)


def figure(number: float, digits: int = 3) -> str:
    """Return a number with some significant digits, by a power of ten where it is very large or very small."""
    if not math.isfinite(number):
        return "not finite"
    if number == 0:
        return "0"
    # The exponent is that of the rounded number, because rounding may carry.
    mantissa, _, power = f"{number:.{digits - 1}e}".partition("e")
    exponent = int(power)
    if -4 <= exponent < 7:
        text = f"{number:,.{max(0, digits - 1 - exponent)}f}"
    else:
        text = f"{mantissa} {TIMES} 10{str(exponent).translate(_RAISED)}"
    return text.replace("-", MINUS)


def seconds(number: float) -> str:
    """Return a time in seconds, or in minutes and seconds."""
    if number < 60:
        return f"{number:.1f} s"
    minutes, rest = divmod(round(number), 60)
    return f"{minutes} min {rest} s"


def share(part: float, whole: float) -> str:
    """Return a part in percent of the whole."""
    percent = 100 * part / whole if whole else 0.0
    if 0 < percent < 0.1:
        return "< 0.1 %"
    return f"{percent:.1f} %" if percent < 99.95 or part == whole else "> 99.9 %"


def memory(megabytes: float) -> str:
    """Return an amount of memory."""
    return f"{megabytes / 1000:.2f} GB" if megabytes >= 1000 else f"{megabytes:.0f} MB"
