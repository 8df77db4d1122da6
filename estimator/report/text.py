"""Numbers as a certificate prints them: the uncertainty with two significant digits, the value to the same place."""

from datetime import UTC, datetime

import numpy as np

MINUS = "\u2212"
NARROW = "\u202f"


def decimals(uncertainty: float, digits: int = 2) -> int:
    """Places after the point at which `uncertainty` shows `digits` significant digits; negative left of the point."""
    if not np.isfinite(uncertainty) or uncertainty <= 0:
        return 3
    exponent = int(np.floor(np.log10(uncertainty)))
    # 9.96 becomes 10 when it is rounded, one place less.
    if round(uncertainty / 10.0**exponent, digits - 1) >= 10:
        exponent += 1
    return digits - 1 - exponent


def fixed(value: float, places: int) -> str:
    """The value rounded to `places`, with a true minus sign and no minus before zero."""
    if not np.isfinite(value):
        return "not finite"
    text = f"{round(value, places):.{max(places, 0)}f}"
    if text.strip("-0.") == "":
        text = text.lstrip("-")
    return text.replace("-", MINUS)


def significant(value: float, digits: int = 2) -> str:
    """The value with `digits` significant digits."""
    return fixed(value, decimals(abs(value), digits)) if value else "0"


def mm(length_m: float, digits: int = 2) -> str:
    """A length in millimetres with its unit."""
    return f"{significant(length_m * 1e3, digits)} mm"


def mm_with(value_m: float, uncertainty_m: float) -> str:
    """`352.0 ± 4.8 mm`."""
    places = decimals(uncertainty_m * 1e3)
    return f"{fixed(value_m * 1e3, places)} ± {fixed(uncertainty_m * 1e3, places)} mm"


def with_sigma(value: float, sigma: float) -> str:
    """Value and standard uncertainty to the same place, without unit."""
    places = decimals(sigma)
    return f"{fixed(value, places)} ± {fixed(sigma, places)}" if sigma > 0 else f"{value:.6g}".replace("-", MINUS)


def utc(stamp_ns: int) -> str:
    """A stamp as date and time; stamps that do not count from 1970 are given in seconds."""
    seconds = stamp_ns // 1_000_000_000
    if not 946_684_800 <= seconds < 7_258_118_400:  # the years 2000 to 2199
        return f"{stamp_ns * 1e-9:.1f} s (log time)"
    return datetime.fromtimestamp(seconds, UTC).strftime("%Y-%m-%d %H:%M:%S UTC")


def duration(seconds: float) -> str:
    """`4.0 s`, `3 min 20 s`, `2 h 5 min`."""
    if seconds < 120:
        return f"{seconds:.1f} s"
    minutes, rest = divmod(round(seconds), 60)
    if minutes < 120:
        return f"{minutes} min {rest} s" if rest else f"{minutes} min"
    return f"{minutes // 60} h {minutes % 60} min"
