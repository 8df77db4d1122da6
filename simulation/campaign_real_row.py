"""A line of the table of real recordings."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class RealRow:
    """One comparison."""

    recording: str
    quantity: str
    value: str
    reference: str
    """`truth` (an instrument) or `reference` (another estimator)."""
