"""Losing the way, and finding it: where a pair stands that the tracks do not lead to."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ...factors.measurements import StereoFrame
from .atlas import AtlasPlace, View
from .geometry import Float
from .images import Image
from .places import ALIKE, BEFORE_ALL_NS, PlaceStore, Relocalisation
from .settings import StereoSettings
from .tracks import Int

FADING = 0.7
"""Share of the velocity that is left after each frame without tracks: a hand does not go straight on for seconds."""
STRAYED_ALIKE = 0.4
"""Correlation of thumbnails from which on a place is worth a look after the tracks have broken."""
APART_M = 1000.0
"""Between chains that nothing joins."""


@dataclass(frozen=True, slots=True)
class Found:
    """Where a pair stands by a remembered place."""

    chain_T_this: Float
    """Shape (4, 4)."""
    joins: bool
    """The place is of an earlier run, of whose chain the own one was no part."""


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
        self.apart = False
        """Places of an earlier run are remembered, and none of them has been seen."""

    def recall(self, places: Sequence[AtlasPlace]) -> float:
        """Places of an earlier run; where the own chain may begin without being near to any, m."""
        self.places.recall(places)
        self.apart = bool(places)
        return APART_M + max((float(np.abs(place.chain_T_keyframe[:3, 3]).max()) for place in places), default=0.0)

    def join(self, new_T_old: Float) -> None:
        """The own chain becomes part of the earlier run's."""
        self.places.move(new_T_old)
        self.apart = False

    def find(self, left: Image) -> list[Relocalisation]:
        """Remembered keyframes that show the same place as a left image, the best first."""
        return self.places.find(left, self._settings.min_relocalisation)

    def lost(self, left: Image, last_ns: int) -> Found | None:
        """The tracks have broken: where this is by a remembered place, None where the view is strange.

        Args:
            left: the image that they do not lead to.
            last_ns: the last one that they did lead to.
        """
        found = self._of_before(left) or [f for f in self.find(left) if not self._joins(f)]
        if not found:
            self._strayed_ns = last_ns if self._strayed_ns is None else self._strayed_ns
            return None
        self._strayed_ns = None
        return self._pose(found[0])

    def look_back(self, left: Image, stamp_ns: int) -> Found | None:
        """By a place of long before, or of before the tracks broke; to be verified."""
        if self.apart:
            found = next(iter(self._of_before(left)), None)
            return None if found is None else self._pose(found)
        before_ns, alike = stamp_ns - self._settings.loop_ns, ALIKE
        if self._strayed_ns is not None:
            before_ns, alike = max(before_ns, self._strayed_ns), STRAYED_ALIKE
        found = self.places.look_back(left, before_ns, 2 * self._settings.min_relocalisation, alike)
        return None if found is None else self._pose(found)

    def verified(self) -> None:
        """Landmarks of the place that was found are seen: nobody is lost."""
        self._strayed_ns = None

    def remember(
        self, frame: StereoFrame, chain_T_this: Float, left: Image, raw_px: Float, points_m: Float
    ) -> View | None:
        """A keyframe with its features (n, 2) and their places (n, 3) in its left camera; what it adds."""
        ids: Int = frame.track_ids
        return self.places.add(frame.stamp_ns, chain_T_this, left, ids, raw_px, points_m)

    def _of_before(self, left: Image) -> list[Relocalisation]:
        """Places of an earlier run, while its chain is another one: to join them takes more."""
        return self.places.find(left, 2 * self._settings.min_relocalisation, BEFORE_ALL_NS) if self.apart else []

    def _pose(self, found: Relocalisation) -> Found:
        return Found(self.places.chain_pose(found.stamp_ns) @ found.keyframe_T_this, self._joins(found))

    def _joins(self, found: Relocalisation) -> bool:
        return self.apart and found.stamp_ns < BEFORE_ALL_NS
