"""The clicked images with the estimate's place and uncertainty in them."""

import gtsam
import numpy as np
from numpy.typing import NDArray

from ..factors import keys
from ..factors.measurements import Pick
from ..factors.noise import sigmas
from ..factors.projection import machine_projection, mobile_projection
from ..frontends.undistort import distort, distortion_jacobian
from .engine import Engine
from .linear import LinearSystem
from .pipe_parts import SeenFrom
from .result import PickRecord, PickView

Float = NDArray[np.float64]

PER_POINT = 4
LARGEST_BYTES = 1_200_000
"""Of all images together: with the rest of a report that stays below 3 MB."""


def pick_views(engine: Engine, values: gtsam.Values, system: LinearSystem) -> tuple[PickView, ...]:
    """At most four per point: the newest of each camera first, then the newest others.

    Where many points fill the space, all keep their best views and lose their last ones.
    """
    ranked = [_ranked(engine, point_id) for point_id in engine.pipes.points]
    kept: list[tuple[int, SeenFrom, Pick]] = []
    size = 0
    for rank in range(PER_POINT):
        for index, seen in enumerate(ranked):
            if rank < len(seen):
                where, pick = seen[rank]
                size += len(engine.pick_images[_name(pick)].png)
                if size > LARGEST_BYTES:
                    break
                kept.append((index, where, pick))
    return tuple(
        _view(engine, values, system, where, pick)
        for _, where, pick in sorted(kept, key=lambda k: (k[0], -k[2].stamp_ns))
    )


def pick_records(engine: Engine) -> tuple[PickRecord, ...]:
    """All clicks of the operator, in their order."""
    return tuple(
        PickRecord(p.point_id, p.role, p.camera, p.stamp_ns, p.raw_px, float(np.sqrt(np.trace(p.covariance_px2) / 2)))
        for p in engine.picks
    )


def _ranked(engine: Engine, point_id: str) -> list[tuple[SeenFrom, Pick]]:
    """Clicks of a point with an image, one per image."""
    images: dict[tuple[str, int], tuple[SeenFrom, Pick]] = {}
    for where, pick in engine.pipes.clicked:
        if pick.point_id == point_id and _name(pick) in engine.pick_images:
            images[pick.camera, pick.stamp_ns] = (where, pick)
    newest = sorted(images.values(), key=lambda s: (-s[1].stamp_ns, s[1].camera))
    cameras: set[str] = set()
    first, others = [], []
    for seen in newest:
        (others if seen[1].camera in cameras else first).append(seen)
        cameras.add(seen[1].camera)
    return [*first, *others][:PER_POINT]


def _name(pick: Pick) -> tuple[str, int, str]:
    return pick.camera, pick.stamp_ns, pick.point_id


def _view(engine: Engine, values: gtsam.Values, system: LinearSystem, where: SeenFrom, pick: Pick) -> PickView:
    point = keys.point(engine.pipes.points[pick.point_id].index)
    ideal, covariance = seen_pixel(values, system, pick.camera, where.key, point)
    camera, image = engine.cameras[pick.camera], engine.pick_images[_name(pick)]
    turn = distortion_jacobian(camera, ideal[None])[0]
    return PickView(
        camera=pick.camera,
        stamp_ns=pick.stamp_ns,
        point_id=pick.point_id,
        image=image.png,
        pixel=distort(camera, ideal[None])[0] - np.array(image.corner_px, float),
        ellipse_px2=turn @ covariance @ turn.T,
    )


def seen_pixel(values: gtsam.Values, system: LinearSystem, camera: str, pose: int, point: int) -> tuple[Float, Float]:
    """Where the estimated point lies in an image (ideal pixels, shape (2,)), and its covariance (2, 2).

    The covariance is of the joint of camera pose, point and calibration.
    """
    unit = sigmas([1.0, 1.0])
    if camera == "b_rgb":
        factor = machine_projection(np.zeros(2), unit, pose, point)
    else:
        factor = mobile_projection(camera, np.zeros(2), unit, pose, point)
    linear = factor.linearize(values)
    # The factor's error is the projection less the measured pixel, which is zero here.
    jacobian, error = linear.jacobian()
    blocks, column = [], 0
    for key in linear.keys():
        size = system.columns[key].stop - system.columns[key].start
        blocks.append((key, jacobian[:, column : column + size]))
        column += size
    return -np.asarray(error).ravel(), system.covariance(blocks)
