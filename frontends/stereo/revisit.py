"""Landmarks seen again in a keyframe, verified by a common motion."""

import numpy as np
from numpy.typing import NDArray

from ..undistort import distort, undistort
from . import points
from .geometry import Float, StereoGeometry, inverse, project, transform
from .landmarks import Candidates, LandmarkStore
from .motion import Motion, estimate_motion
from .observer import Keyview, Observer
from .settings import StereoSettings
from .sighting import Sighting, nothing_seen
from .tracks import Tracks, no_tracks
from .vertical import VerticalCorrection

_DRIFT_PX = 1.5
"""Standard deviation of a stored point against its neighbours, seen from here."""
_LEAST = 6
"""Fewer finds do not verify each other."""
_ENOUGH = 25
"""Fewer finds do not hold the pose better than the chain does."""


def revisit(
    view: Keyview,
    store: LandmarkStore,
    rows: NDArray[np.intp],
    chain_T_this: Float,
    observer: Observer,
    rig: StereoGeometry,
    vertical: VerticalCorrection,
    settings: StereoSettings,
) -> tuple[Tracks, Sighting, Float]:
    """Tracks that go on under their old ids, what was seen of them, and how the finds correct the pose.

    Args:
        view: the keyframe.
        store: where the landmarks wait; those found leave it.
        rows: (n,), candidates in the store.
        chain_T_this: (4, 4), the keyframe's pose in the chain.
        observer: aligns and gives covariances.
        rig: nominal geometry.
        vertical: the right image's offset.
        settings: thresholds.

    Returns:
        tracks, sighting and `this_T_corrected` (4, 4), the identity without enough finds.
    """
    nothing = no_tracks(observer.grid), nothing_seen(), np.eye(4)
    if len(rows) < _LEAST:
        return nothing
    here = transform(inverse(chain_T_this), store.points[rows])
    candidates = Candidates(rows, here, distort(rig.left, project(here, rig.left)))
    left, patches, found = store.find_left(
        view.pair.left,
        view.left,
        candidates,
        chain_T_this,
        rig,
        observer.grid,
        settings.min_correlation,
        observer.mismatch(view),
    )
    left_px = undistort(rig.left, left.px)[0]
    found &= np.isfinite(left_px).all(axis=1)
    motion = _agreement(here[found], left_px[found], rig) if found.sum() >= _LEAST else None
    if motion is None:
        # A covered lens or a pose that is far off hides them all; that is not the landmarks' fault.
        return nothing
    chosen = np.flatnonzero(found)[motion.inliers]
    store.missed(np.delete(rows, chosen))
    corrected = transform(inverse(motion.reference_T_this), here[chosen])
    tracks = store.revive(rows[chosen], left.px[chosen], left_px[chosen], patches.take(chosen), corrected)
    pose = chain_T_this @ motion.reference_T_this
    sighting = observer.complete(view, tracks, pose, left.take(chosen))
    tracks, sighting = _measured(store, rows[chosen], tracks, sighting, pose, rig, vertical)
    return tracks, sighting, motion.reference_T_this if len(chosen) >= _ENOUGH else np.eye(4)


def _agreement(here: Float, left_px: Float, rig: StereoGeometry) -> Motion | None:
    """The motion that the finds agree on, from the expected pose to theirs."""
    n = len(here)
    lateral = (_DRIFT_PX * here[:, 2] / rig.left.fx) ** 2
    px = np.hstack((left_px, np.full((n, 2), np.nan)))
    pixels = np.broadcast_to(np.eye(4), (n, 4, 4))
    motion = estimate_motion(here, lateral[:, None, None] * np.eye(3), px, pixels, [np.eye(4)], rig, _LEAST)
    return motion if motion is not None and motion.inliers.mean() > 0.5 else None


def _measured(
    store: LandmarkStore,
    rows: NDArray[np.intp],
    tracks: Tracks,
    sighting: Sighting,
    chain_T_this: Float,
    rig: StereoGeometry,
    vertical: VerticalCorrection,
) -> tuple[Tracks, Sighting]:
    """The finds in both images; their points are measured anew, since the old places have drifted."""
    good = np.isfinite(sighting.right_px[:, 0])
    store.forget(rows[good])
    tracks, sighting = tracks.take(good), sighting.take(good)
    tracks.keyframe_px = sighting.left_px
    points.measure(tracks, sighting, chain_T_this, rig, vertical)
    return tracks, sighting
