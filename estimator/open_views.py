"""What was seen in a picture of which it is not known where it was taken from."""

from dataclasses import dataclass, field

from ..factors.measurements import OutlineSighting, Pick

UNPLACED = "the camera's place is unknown, places"
"""Why something that it saw does not enter."""
MOST = 100
"""That a run without end keeps, of each."""


@dataclass(slots=True)
class OpenViews:
    """Clicks and outlines that wait for their camera's place."""

    picks: list[tuple[Pick, tuple[float, float] | None]] = field(default_factory=list)
    """With the depth under them, and its sigma."""
    outlines: list[OutlineSighting] = field(default_factory=list)

    def stamps(self) -> set[int]:
        """Of the pictures."""
        return {pick.stamp_ns for pick, _ in self.picks} | {outline.stamp_ns for outline in self.outlines}

    def shorten(self) -> None:
        """The oldest have waited in vain."""
        del self.picks[:-MOST]
        del self.outlines[:-MOST]
