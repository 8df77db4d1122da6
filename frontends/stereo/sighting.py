"""What one keyframe saw of its tracks."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...factors.measurements import StereoFrame
from .geometry import Float, block_diagonal

Bool = NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class Sighting:
    """n features in ideal pixels; right ones are NaN where there is no match."""

    left_px: Float
    """Shape (n, 2)."""
    left_covariance: Float
    """Shape (n, 2, 2)."""
    right_px: Float
    """Shape (n, 2)."""
    right_covariance: Float
    """Shape (n, 2, 2)."""

    @property
    def covariance(self) -> Float:
        """Shape (n, 4, 4), left and right together."""
        return block_diagonal(self.left_covariance, self.right_covariance)

    def take(self, mask: NDArray[np.intp] | Bool) -> "Sighting":
        """The features of a mask or index."""
        return Sighting(
            self.left_px[mask], self.left_covariance[mask], self.right_px[mask], self.right_covariance[mask]
        )

    def scaled(self, factor: float) -> "Sighting":
        """The same with covariances multiplied by a factor."""
        return Sighting(self.left_px, factor * self.left_covariance, self.right_px, factor * self.right_covariance)

    def append(self, other: "Sighting") -> "Sighting":
        """These features followed by others."""
        return Sighting(
            np.concatenate((self.left_px, other.left_px)),
            np.concatenate((self.left_covariance, other.left_covariance)),
            np.concatenate((self.right_px, other.right_px)),
            np.concatenate((self.right_covariance, other.right_covariance)),
        )


def nothing_seen() -> Sighting:
    """No feature."""
    none, no_covariance = np.zeros((0, 2)), np.zeros((0, 2, 2))
    return Sighting(none, no_covariance, none, no_covariance)


def blind_frame(stamp_ns: int, last_T_this: Float) -> StereoFrame:
    """A frame that shows nothing."""
    seen = nothing_seen()
    return StereoFrame(
        stamp_ns=stamp_ns,
        is_keyframe=False,
        track_ids=np.zeros(0, dtype=np.int64),
        left_px=seen.left_px,
        left_covariance_px2=seen.left_covariance,
        right_px=seen.right_px,
        right_covariance_px2=seen.right_covariance,
        last_T_this=last_T_this,
        motion_inliers=0,
        lost=True,
    )


def plain_frame(
    stamp_ns: int, ids: NDArray[np.int64], left_px: Float, variance_px2: float, last_T_this: Float, inliers: int
) -> StereoFrame:
    """A frame between keyframes: ideal left pixels (n, 2) as the flow leaves them."""
    n = len(ids)
    return StereoFrame(
        stamp_ns=stamp_ns,
        is_keyframe=False,
        track_ids=ids.copy(),
        left_px=left_px,
        left_covariance_px2=np.tile(variance_px2 * np.eye(2), (n, 1, 1)),
        right_px=np.full((n, 2), np.nan),
        right_covariance_px2=np.tile(np.eye(2), (n, 1, 1)),
        last_T_this=last_T_this,
        motion_inliers=inliers,
    )


def keyframe_of(
    stamp_ns: int, ids: NDArray[np.int64], sighting: Sighting, last_T_this: Float, inliers: int, lost: bool
) -> StereoFrame:
    """A keyframe with what was seen of its tracks."""
    return StereoFrame(
        stamp_ns=stamp_ns,
        is_keyframe=True,
        track_ids=ids.copy(),
        left_px=sighting.left_px,
        left_covariance_px2=sighting.left_covariance,
        right_px=sighting.right_px,
        right_covariance_px2=sighting.right_covariance,
        last_T_this=last_T_this,
        motion_inliers=inliers,
        lost=lost,
    )
