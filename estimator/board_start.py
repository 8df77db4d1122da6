"""The first pose of a board: which of the two that a plane has, and with what side length."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import gtsam
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from ..factors import keys
from ..factors.board import page_corners
from ..factors.camera import CameraModel
from ..factors.errors import ObservabilityError
from ..factors.geometry import pose3
from ..factors.measurements import MarkerSighting
from ..factors.rig import Noise, Rig
from ..frontends.board_fit import corner_covariance
from ..frontends.board_pose import PoseCandidate, apparent_side, board_pose_candidates
from .graph import State
from .sheet import Sheet

Float = NDArray[np.float64]

SINGLE_VIEWS = 10
"""A page of several markers that never shows two of them at once starts from one after so many views."""
MESSAGE_INSET_SIGMA_PX = 0.5
"""Corners of an unknown detector: OpenCV's common settings put them 0.2 to 0.8 px inside the marker."""
LEAST_INSET_SIGMA_PX = 0.004
"""What the own corner fit leaves on images without noise."""
ROUGH_TILT_RAD = 0.05
"""A tilt known worse than this is no start where its sign is in doubt."""
WRONG_BRANCH = 18.4
"""Chi-square by which the worse of two poses has to lose before it is ruled out: one in ten thousand."""


@dataclass(frozen=True, slots=True)
class Side:
    """An apparent side length; `sigma_m` None: nothing but the rig says so."""

    length_m: float
    sigma_m: float | None


@dataclass(frozen=True, slots=True)
class Start:
    """Where a board begins."""

    o_T_f: gtsam.Pose3
    side: Side
    sure: bool
    """False: the other pose of the plane is not ruled out."""


@dataclass(frozen=True, slots=True)
class _View:
    """The corners of one board in one image, and where its camera stands."""

    K: Float
    o_T_c: gtsam.Pose3
    page_m: Float
    px: Float
    root: Float
    """Shape (n, 2, 2), whitening."""


class FirstPose:
    """Looks at the views of a board that has no pose yet."""

    def __init__(self, rig: Rig, state: State) -> None:
        self._rig = rig
        self._state = state

    def pinhole(self, camera: str) -> CameraModel:
        """A camera as it is believed to be now, for ideal pixels."""
        K = self._state.intrinsics(keys.intrinsics(camera)).K()
        return CameraModel(camera, 0, 0, K, "none", np.zeros(0), np.eye(3), None)

    def margin(self, sheet: Sheet, seen: Sequence[MarkerSighting]) -> float:
        """Chi-square by which an image rules out the second pose of a board; infinite where it does, -1 without any."""
        found = self._candidates(sheet, seen, self.side(sheet, seen))
        if not found:
            return -1.0
        if len(found) > 1:
            return found[1].chi2 - found[0].chi2
        return 0.0 if _frontal(found[0], seen) else float("inf")

    def side(self, sheet: Sheet, seen: Sequence[MarkerSighting]) -> Side:
        """The side length that views of one moment show: by the places of several markers, else by stereo."""
        board = sheet.board
        mine = _of_best_camera(seen)
        if len({s.marker for s in mine}) > 1:
            camera, common = self.pinhole(mine[0].camera), self._rig.noise.marker_common_px
            try:
                length, sigma = apparent_side(mine, board, camera, common)
            except ObservabilityError:  # corners that no pose explains say nothing of the side
                return Side(board.side_m, None)
            spread = np.array([sheet.marker(s.marker).centre_m for s in mine])
            radius = float(np.sqrt(((spread - spread.mean(0)) ** 2).sum()))
            half_px = 0.5 * float(np.mean([s.diagonal_px for s in mine]))
            inset = inset_sigma_px(mine[0], self._rig.noise) / half_px
            place = board.centre_sigma_m * np.sqrt(2) / radius
            return Side(length, float(np.linalg.norm([sigma, length * place, length * inset])))
        return self._stereo_side(seen) or Side(board.side_m, None)

    def _stereo_side(self, seen: Sequence[MarkerSighting]) -> Side | None:
        """Mean edge of a marker that both mobile cameras see, by triangulation with the calibration believed now."""
        seen = [s for s in seen if not s.gross]
        left = {s.marker: s for s in seen if s.camera == "m_left"}
        both = [(left[s.marker], s) for s in seen if s.camera == "m_right" and s.marker in left]
        if not both:
            return None
        a, b = both[0]
        l_T_r = self._state.pose(keys.extrinsics("m_right"))
        K = self.pinhole("m_left").K
        rays = _rays(a.corners_px, K)
        other = _rays(b.corners_px, self.pinhole("m_right").K) @ l_T_r.rotation().matrix().T
        t = l_T_r.translation()
        # s * ray - u * other = t: least squares, in closed form
        aa, bb, ab = (rays**2).sum(1), (other**2).sum(1), (rays * other).sum(1)
        depth = (bb * (rays @ t) - ab * (other @ t)) / (aa * bb - ab**2)
        if not (np.isfinite(depth).all() and (depth > 0.05).all()):
            return None
        # the mean depth for all corners: single ones are noisy, and noise makes edges longer
        plane = rays * depth.mean()
        length = float(np.linalg.norm(plane - np.roll(plane, 1, axis=0), axis=1).max())
        stereo, z = self._rig.stereo, float(depth.mean())
        baseline = float(np.linalg.norm(t))
        parallax = z / baseline * np.hypot(stereo.rotation_sigma_rad, _sigma_px(both[0]) / K[0, 0])
        tilt = 1.0 - float(np.linalg.norm(plane - np.roll(plane, 1, axis=0), axis=1).min()) / length
        return Side(length, length * float(np.linalg.norm([stereo.baseline_sigma_rel, parallax, tilt])))

    def _candidates(self, sheet: Sheet, seen: Sequence[MarkerSighting], side: Side) -> list[PoseCandidate]:
        mine = _of_best_camera(seen)
        camera = self.pinhole(mine[0].camera)
        return board_pose_candidates(mine, sheet.board, camera, side.length_m, self._rig.noise.marker_common_px)

    def find(
        self, sheet: Sheet, camera_poses: Mapping[str, gtsam.Pose3], seen: Sequence[MarkerSighting], force: bool
    ) -> Start | None:
        """The pose that the last view and all those held back agree on; None while two remain possible."""
        several = len(sheet.board.markers) > 1
        if several and not force and len({s.marker for s in seen}) < 2 and len(sheet.held) < SINGLE_VIEWS:
            return None
        side = self.side(sheet, seen)
        # the camera that sees most of it, unless another one alone rules out the second pose
        by_camera = [[s for s in seen if s.camera == c] for c in dict.fromkeys(s.camera for s in seen)]
        ranked = sorted(by_camera, key=lambda mine: (-self.margin(sheet, mine), -len(mine)))
        camera = ranked[0][0].camera
        found = self._candidates(sheet, ranked[0], side)
        starts = [camera_poses[camera].compose(pose3(c.camera_T_f)) for c in found]
        if not starts:
            return None
        if len(starts) == 1:
            sure = not _frontal(found[0], ranked[0])
            return Start(starts[0], side, sure) if sure or force else None
        views = [v for key, held in sheet.held for v in self._views(sheet, key, held, side.length_m)]
        fits = sorted((_refined(start, views) for start in starts), key=lambda fit: fit[0])
        scale = max(1.0, fits[0][0] / max(sum(2 * len(v.px) for v in views) - 6, 1))
        sure = fits[1][0] - fits[0][0] > WRONG_BRANCH * scale or fits[0][1].equals(fits[1][1], 1e-3)
        return Start(fits[0][1], side, sure) if sure or force else None

    def _views(self, sheet: Sheet, key: int, seen: Sequence[MarkerSighting], side_m: float) -> list[_View]:
        views = []
        for camera in sorted({s.camera for s in seen}):
            mine = [s for s in seen if s.camera == camera]
            o_T_c = self._state.pose(key)
            if camera != "m_left":
                o_T_c = o_T_c.compose(self._state.pose(keys.extrinsics(camera)))
            common = self._rig.noise.marker_common_px
            covariance = np.concatenate([corner_covariance(s, common)[s.good] for s in mine])
            views.append(
                _View(
                    self.pinhole(camera).K,
                    o_T_c,
                    np.concatenate([page_corners(sheet.marker(s.marker), side_m)[s.good] for s in mine]),
                    np.concatenate([s.corners_px[s.good] for s in mine]),
                    np.asarray(np.linalg.cholesky(np.linalg.inv(covariance)).transpose(0, 2, 1), float),
                )
            )
        return views


def _frontal(pose: PoseCandidate, seen: Sequence[MarkerSighting]) -> bool:
    """The two poses of a lone marker have run together: its tilt is hardly known, and its sign not at all."""
    if len({s.marker for s in seen}) > 1:
        return False
    normal, place = pose.camera_T_f[:3, 2], pose.camera_T_f[:3, 3]
    tilt = float(np.arccos(np.clip(-(normal @ place) / np.linalg.norm(place), -1.0, 1.0)))
    sigma = float(np.sqrt(np.linalg.eigvalsh(pose.covariance[:2, :2])[-1]))
    return sigma > ROUGH_TILT_RAD and (2 * tilt / sigma) ** 2 < WRONG_BRANCH


def _refined(start: gtsam.Pose3, views: list[_View]) -> tuple[float, gtsam.Pose3]:
    """Least squares of a board's pose over several views whose cameras are known: chi-square and pose."""

    def residual(xi: Float) -> Float:
        o_T_f = start.retract(xi)
        parts = []
        for view in views:
            c_T_f = view.o_T_c.inverse().compose(o_T_f).matrix()
            c_p = view.page_m @ c_T_f[:3, :3].T + c_T_f[:3, 3]
            image = c_p @ view.K.T
            px = image[:, :2] / np.maximum(image[:, 2:], 1e-3)
            parts.append(np.einsum("nij,nj->ni", view.root, px - view.px).ravel())
        return np.concatenate(parts)

    fit = least_squares(residual, np.zeros(6), x_scale=np.full(6, 0.1), max_nfev=30)
    return 2.0 * float(fit.cost), start.retract(fit.x)


def _of_best_camera(seen: Sequence[MarkerSighting]) -> list[MarkerSighting]:
    """The sightings of the camera that has most of them."""
    cameras = [s.camera for s in seen]
    best = max(dict.fromkeys(cameras), key=cameras.count)
    return [s for s in seen if s.camera == best]


def _rays(px: Float, K: Float) -> Float:
    return np.stack([(px[:, 0] - K[0, 2]) / K[0, 0], (px[:, 1] - K[1, 2]) / K[1, 1], np.ones(len(px))], axis=1)


def _sigma_px(pair: tuple[MarkerSighting, MarkerSighting]) -> float:
    """Of the disparity of a marker's mean corner."""
    variance = sum(float(np.trace(s.covariance_px2.mean(0))) / 2 for s in pair)
    return float(np.sqrt(variance / 4))


def inset_sigma_px(sighting: MarkerSighting, noise: Noise) -> float:
    """How far the corners of a detector may all lie inside the true ones.

    Corners that came as messages have the covariance that the rig file gives to those; what found them is not known.
    """
    stated = noise.marker_message_sigma_px**2 * np.eye(2)
    told = np.allclose(sighting.covariance_px2, stated, rtol=1e-6, atol=0.0)
    return MESSAGE_INSET_SIGMA_PX if told else max(noise.marker_common_px, LEAST_INSET_SIGMA_PX)


def relabelled(sighting: MarkerSighting, marker: int) -> MarkerSighting:
    """The same corners under another id."""
    return replace(sighting, marker=marker)
