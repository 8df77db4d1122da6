"""Settings of the stereo front end, in pixels of the image at hand, seconds and ratios."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class StereoSettings:
    """Defaults suit a 360x240 pair at 20 Hz; lengths in pixels are those of features, not of the image."""

    max_tracks: int = 160
    """Number of tracks that detection fills up to."""
    min_distance_px: float = 9.0
    """Smallest distance between two features at 360x240; grows with the image's diagonal."""
    flow_window_px: int = 15
    pyramid_levels: int = 3
    forward_backward_px: float = 0.7
    patch_radius_px: int = 7
    """Half size of the square patch that alignment compares."""
    bend_sigma: float = 0.06
    """Standard deviation of a patch's stretch and shear about what the motion predicts (surfaces are slanted)."""
    smoothing_px: float = 0.7
    """Standard deviation of the Gaussian ahead of alignment; it takes the bias of bilinear sampling away."""
    min_correlation: float = 0.8
    """Smallest normalised correlation of a patch with its reference."""
    nearest_baselines: float = 2.5
    """Nearest depth at which a right match is looked for, in baselines."""
    epipolar_gate_px: float = 3.0
    """Rows above and below the nominal epipolar line that are searched."""
    keyframe_parallax: float = 0.12
    """Median flow since the last keyframe that makes a new one, as a share of the image's diagonal. With 0.05 there are
    twice as many: twice the work, the same error of keyframes, and motions whose covariance is further from the truth,
    as neighbours share the errors of their patches. With 0.15 tracks are lost in between."""
    keyframe_rotation_rad: float = 0.3
    keyframe_share: float = 0.5
    """Share of the last keyframe's tracks below which a new keyframe is made."""
    min_tracks: int = 60
    """Absolute number of tracks below which a moving camera makes a new keyframe."""
    still_px: float = 1.0
    """Median flow below which the camera counts as standing still."""
    focal_sigma_rel: float = 0.003
    """How well the cameras' calibration is known: tracks may miss a motion by what it adds."""
    centre_sigma_px: float = 1.0
    min_inliers: int = 12
    min_spread: float = 0.03
    """Smallest standard deviation of the inliers, in the direction of least spread, as a share of the diagonal."""
    min_relocalisation: int = 15
    """Inliers that a remembered place needs to count as found again."""
    loop_ns: int = 10_000_000_000
    """Age of a place that the camera may come back to without its landmarks being found by themselves."""
    revisits: int = 40
    """Number of old landmarks that each keyframe looks for."""
    store_keyframes: int = 400
    """Number of keyframes that are remembered for relocalisation."""
    store_landmarks: int = 10000
    """Number of landmark patches that are remembered."""
