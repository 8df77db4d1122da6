"""{b} without a board: what the machine's cameras see is found in the mobile camera's map."""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ..factors import keys
from ..factors.calibration import depth_sigmas, rgb_mean, rgb_sigmas
from ..factors.geometry import pose3
from ..frontends.cloud.point_registration import PointRegistration, register_points
from ..frontends.cross_view import MappedFeatures, features, find_view, mapped_features
from ..frontends.stereo.geometry import inverse, rotation_angle, transform
from .depth_sensor import DepthView
from .engine import Engine
from .landmark_map import landmark_map
from .sensors import PairImages

Float = NDArray[np.float64]

SPACING_M, SPACING_RAD = 0.3, 0.35
"""Pictures nearer to each other than this show the same features."""
MOST_VIEWS = 40
FIRST_VIEWS = 8
"""So many views before the first search, and so many more before each further one."""


BY_COLOUR_RAD, BY_COLOUR_M = 0.04, 0.12
"""What matches that agree by chance do to a place by colour, beyond its own covariance. Measured: 25 mrad and 80 mm rms
in the worst direction over 13 places in five rendered recordings, 65 mrad and 240 mm the largest."""


@dataclass(frozen=True, slots=True)
class _Guess:
    """`o_T_b` by colour."""

    o_T_b: Float
    """Shape (4, 4)."""
    covariance: Float
    """Shape (6, 6), of xi in o_T_b * Exp(xi), rotation first."""


@dataclass(slots=True)
class _View:
    keyframe: int
    pair: PairImages
    mapped: MappedFeatures | None = field(default=None)


class BaseSearch:
    """Keeps pictures of the way, and looks for the machine's view in them as long as nothing else places {b}."""

    def __init__(self, engine: Engine) -> None:
        self._engine = engine
        self._views: list[_View] = []
        self._searched = 0

    def see(self, pair: PairImages) -> None:
        """A keyframe's pictures."""
        index = self._engine.keyframe_at.get(pair.stamp_ns)
        self._views = [view for view in self._views if self._engine.state.has(keys.keyframe(view.keyframe))]
        if index is None or len(self._views) >= MOST_VIEWS or self._engine.state.has(self._engine.base):
            return
        pose = self._pose(index)
        if self._views:
            step = inverse(self._pose(self._views[-1].keyframe)) @ pose
            if np.linalg.norm(step[:3, 3]) < SPACING_M and rotation_angle(step[:3, :3]) < SPACING_RAD:
                return
        self._views.append(_View(index, pair))

    def search(self, view: DepthView | None, last: bool = False) -> bool:
        """Places {b} by the newest view of the depth camera, where nothing else does or, at the end, has done.

        Returns:
            Whether {b} has a place now that it did not have before.
        """
        engine = self._engine
        mounted = engine.rig.mount is not None and not last
        new = len(self._views) - min(self._searched, len(self._views))
        if view is None or mounted or engine.state.has(engine.base) or not engine.odometry.observations:
            return False
        if new < (1 if last else FIRST_VIEWS):
            return False
        self._searched = len(self._views)
        guess = self._by_colour(view)
        found = None if guess is None else self._on_surfaces(guess.o_T_b, view)
        if guess is None or found is None or not found.plausible:
            return False
        what = f"{found.on_surface} landmarks on the Kinect's surfaces, {found.contradictions} before them"
        by_colour = pose3(guess.o_T_b), guess.covariance
        engine.machine.enter_by_surfaces(pose3(found.o_T_b), by_colour, view.cloud.stamp_ns, what)
        return True

    def _on_surfaces(self, guess: Float, view: DepthView) -> PointRegistration | None:
        sigmas = depth_sigmas(self._engine.rig.kinect)
        return register_points(landmark_map(self._engine).points, view.cloud, guess, sigmas)

    def _by_colour(self, view: DepthView) -> _Guess | None:
        """`o_T_b` from the colour image's features among those of the mobile camera; None where they do not meet."""
        engine = self._engine
        camera = engine.cameras.get("b_rgb")
        if view.colour is None or camera is None:
            return None
        known = [v for v in self._views if not engine.adrift.holds(keys.keyframe(v.keyframe))]
        mapped = [self._mapped(v) for v in known]
        lens = engine.rig.cameras.b_rgb
        sigmas = lens.focal_sigma_rel, lens.centre_sigma_px
        found = find_view(mapped, features(view.colour, camera), camera, sigmas)
        if found is None:
            return None
        b_T_rgb = rgb_mean(engine.rig.kinect)
        turn = b_T_rgb.AdjointMap()
        covariance = found.covariance + np.diag(rgb_sigmas(engine.rig.kinect) ** 2)
        by_chance = np.diag([BY_COLOUR_RAD**2] * 3 + [BY_COLOUR_M**2] * 3)
        return _Guess(found.o_T_c @ b_T_rgb.inverse().matrix(), turn @ covariance @ turn.T + by_chance)

    def _mapped(self, view: _View) -> MappedFeatures:
        """A view's features in {o}, where its keyframe is believed to be now."""
        left, right = (self._engine.cameras[name] for name in ("m_left", "m_right"))
        if view.mapped is None:
            rig = self._engine.state.pose(keys.extrinsics("m_right")).matrix()
            found = features(view.pair.left, left), features(view.pair.right, right)
            view.mapped = mapped_features(*found, left, right, rig)
        return MappedFeatures(view.mapped.descriptors, transform(self._pose(view.keyframe), view.mapped.points_m))

    def _pose(self, keyframe: int) -> Float:
        return self._engine.state.pose(keys.keyframe(keyframe)).matrix()
