"""Losing the way, and finding it: where a pair stands that the tracks do not lead to."""

from ...factors.measurements import StereoFrame
from .geometry import Float
from .images import Image
from .places import ALIKE, PlaceStore, Relocalisation
from .settings import StereoSettings
from .tracks import Int

FADING = 0.7
"""Share of the velocity that is left after each frame without tracks: a hand does not go straight on for seconds."""
STRAYED_ALIKE = 0.4
"""Correlation of thumbnails from which on a place is worth a look after the tracks have broken."""


class Finding:
    """Remembers places, and since when none of them has been found.

    Args:
        places: keyframes of before.
        settings: thresholds.
    """

    def __init__(self, places: PlaceStore, settings: StereoSettings) -> None:
        self.places = places
        self._settings = settings
        self._strayed_ns: int | None = None
        """When the tracks broke without a known place having been found since."""

    def find(self, left: Image) -> list[Relocalisation]:
        """Remembered keyframes that show the same place as a left image, the best first."""
        return self.places.find(left, self._settings.min_relocalisation)

    def lost(self, left: Image, last_ns: int) -> Float | None:
        """The tracks have broken: `chain_T_this` (4, 4) by a remembered place, None where the view is strange.

        Args:
            left: the image that they do not lead to.
            last_ns: the last one that they did lead to.
        """
        found = self.find(left)
        if not found:
            self._strayed_ns = last_ns if self._strayed_ns is None else self._strayed_ns
            return None
        self._strayed_ns = None
        return self._pose(found[0])

    def look_back(self, left: Image, stamp_ns: int) -> Float | None:
        """`chain_T_this` by a place of long before, or of before the tracks broke; to be verified."""
        before_ns, alike = stamp_ns - self._settings.loop_ns, ALIKE
        if self._strayed_ns is not None:
            before_ns, alike = max(before_ns, self._strayed_ns), STRAYED_ALIKE
        found = self.places.look_back(left, before_ns, 2 * self._settings.min_relocalisation, alike)
        return None if found is None else self._pose(found)

    def verified(self) -> None:
        """Landmarks of the place that was found are seen: nobody is lost."""
        self._strayed_ns = None

    def remember(self, frame: StereoFrame, chain_T_this: Float, left: Image, raw_px: Float, points_m: Float) -> None:
        """A keyframe with its features (n, 2) and their places (n, 3) in its left camera."""
        ids: Int = frame.track_ids
        self.places.add(frame.stamp_ns, chain_T_this, left, ids, raw_px, points_m)

    def _pose(self, found: Relocalisation) -> Float:
        return self.places.chain_pose(found.stamp_ns) @ found.keyframe_T_this
