"""Views and patches of the map's landmarks, so that a later run can find its way in it."""

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from ..frontends.stereo.atlas import Atlas, AtlasPlace, AtlasTracks, joined

MOST_PATCHES = 4000
"""8 MB."""
MOST_PLACES = 120
"""2 MB."""
KEPT_PLACES, KEPT_PATCHES = 24, 400
"""In a checkpoint: less than 2 MB."""
FEWEST_VIEWS = 2
FEWEST_IN_PLACE = 12
"""A view with fewer landmarks does not place a camera."""


@dataclass(slots=True)
class Album:
    """What the front end has said that can be found again, bounded."""

    _places: list[AtlasPlace] = field(default_factory=list)
    _patches: dict[int, AtlasTracks] = field(default_factory=dict)
    """By track, one row each, the oldest first."""
    _earlier: dict[int, int] = field(default_factory=dict)
    """How many keyframes of an earlier run saw each track, in the map or not: most of it is not seen again at once."""

    def recall(self, atlas: Atlas) -> None:
        """What an earlier run kept."""
        self._earlier = dict(zip(atlas.tracks.ids.tolist(), atlas.tracks.views.tolist(), strict=True))
        self.add(atlas)

    def add(self, seen: Atlas, known: Collection[int] = ()) -> None:
        """What a keyframe adds.

        Args:
            known: tracks that are landmarks of the map.
        """
        for row, track in enumerate(seen.tracks.ids.tolist()):
            self._patches[track] = seen.tracks.take([row])
        self._places += seen.places
        if len(self._patches) > MOST_PATCHES:
            self._forget_patches(known)
        if len(self._places) > MOST_PLACES:
            counts = [sum(track in known for track in place.ids.tolist()) for place in self._places]
            newest = max(len(counts) - 10, 0)  # their tracks may not be landmarks yet
            del self._places[min(range(newest), key=counts.__getitem__)]

    def _forget_patches(self, known: Collection[int]) -> None:
        """Of what is no landmark, and then of the oldest, down to three quarters."""
        spare = [t for t in self._patches if t not in known] + [t for t in self._patches if t in known]
        for track in spare[: len(self._patches) - 3 * MOST_PATCHES // 4]:
            del self._patches[track]

    def chosen(self, views: Mapping[int, int], joint: int) -> tuple[Atlas, list[int]]:
        """What a checkpoint keeps, and the tracks of it whose places are to be kept with their covariance.

        Few places that show all there is, and of each of them its landmarks in turn, the surest first.

        Args:
            views: number of keyframes that have seen each landmark of the map.
            joint: number of landmarks with covariance, at most.
        """
        counts = {t: n for t, n in (self._earlier | dict(views)).items() if n >= FEWEST_VIEWS and t in self._patches}
        good = set(counts)
        places = self._covering(good)
        turns = [
            sorted(good.intersection(p.ids.tolist()), key=lambda t: (t not in views, -counts[t], t)) for p in places
        ]
        order = _in_turn(turns)
        if not order:
            return Atlas(), []
        chosen = [t for t in order if t in views][:joint]
        kept = list(dict.fromkeys([*chosen, *order]))[:KEPT_PATCHES]
        tracks = joined([self._patches[t] for t in kept])
        return Atlas(tuple(places), replace(tracks, views=np.array([counts[t] for t in kept], np.int64))), chosen

    def _covering(self, good: set[int]) -> list[AtlasPlace]:
        """Places, the one that shows most of what the others do not first; the newer one of two that show as much."""
        left, found, uncovered = list(reversed(self._places)), [], set(good)
        while left and len(found) < KEPT_PLACES:
            best = max(left, key=lambda place: len(uncovered.intersection(place.ids.tolist())))
            shown = good.intersection(best.ids.tolist())
            if not shown & uncovered:
                break
            left = [place for place in left if place is not best]
            uncovered -= shown
            if len(shown) >= FEWEST_IN_PLACE:
                found.append(best)
        return found


def _in_turn(lists: list[list[int]]) -> list[int]:
    """The first of each list, then the second of each, and so on; each once."""
    longest = max((len(part) for part in lists), default=0)
    return list(dict.fromkeys(part[i] for i in range(longest) for part in lists if i < len(part)))
