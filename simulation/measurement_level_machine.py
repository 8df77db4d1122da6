"""What the Kinect measures, and the operator's clicks with the pipe's outline round them."""

import numpy as np

from ..estimator.baseline import ClickedPoint
from ..estimator.pipes import EDGE_FLOOR_PX
from ..factors.cloud import depth_moves
from ..factors.measurements import CloudFrame, CylinderSighting, OutlineSighting, Pick
from ..factors.outline import outline_lines
from ..factors.pipe import across_axis
from ..frontends.cloud.noise import SMOOTH_SHARE
from .measurement_level_scene import cast, occluded
from .measurement_level_truth import KINECT_FOCAL_PX, Float, invert, transform
from .measurement_level_world import World, inside, project, spoil

KINECT_SIZE = (640, 480)
CYLINDER_ACROSS_SIGMA_M, CYLINDER_RADIUS_SIGMA_M = 0.0005, 0.0008
"""What fits to rendered clouds at 1.5 to 2 m state; along the view the depth camera's own errors decide."""
MATCH_SIGMA_PX = 0.25
"""Disparity error of semi-global matching at a window's median."""


def cloud_frames(world: World) -> list[CloudFrame]:
    """Kinect depth samples on a coarse, shifted grid of the image."""
    settings, rng = world.scenario.clouds, world.rng
    if settings.frames == 0:
        return []
    moments = np.linspace(0, len(world.stamps_ns) - 1, settings.frames).astype(int)
    return [_cloud_frame(world, world.stamps_ns[i], settings.points, rng) for i in moments]


def _cloud_frame(world: World, stamp_ns: int, count: int, rng: np.random.Generator) -> CloudFrame:
    pixels = rng.uniform([8.0, 8.0], [KINECT_SIZE[0] - 8.0, KINECT_SIZE[1] - 8.0], (count, 2))
    centre = 0.5 * np.array(KINECT_SIZE) - 0.5
    given_rays = np.c_[(pixels - centre) / KINECT_FOCAL_PX, np.ones(count)]
    shift, scale = world.true.depth_rays[:2], world.true.depth_rays[2]
    b_rays = np.c_[given_rays[:, :2] * (1.0 + scale) + shift, np.ones(count)]
    distance, w_normals, _ = cast(world.scene.w_T_b[:3, 3], b_rays @ world.scene.w_T_b[:3, :3].T, world.scene)
    normals = w_normals @ world.scene.w_T_b[:3, :3]
    normals = normals * -np.sign((normals * b_rays).sum(1, keepdims=True))
    slope = np.abs((normals * b_rays).sum(1))
    usable = np.isfinite(distance) & (distance > 0.5) & (distance < 4.0) & (slope > 0.3)
    depth_m, given_rays, normals, slope = distance[usable], given_rays[usable], normals[usable], slope[usable]
    sigma_z = kinect_sigma_m(depth_m)
    measured = (depth_m - world.true.depth_offset_m) / (1.0 + world.true.depth_scale)
    measured = measured + rng.normal(0.0, 1.0, len(depth_m)) * sigma_z * world.scenario.noise_factors.clouds
    outliers = world.scenario.outliers
    if "clouds" in outliers.families:
        hit = world.outlier_rng.random(len(measured)) < outliers.share
        measured = measured + hit * world.outlier_rng.uniform(-outliers.size_m, outliers.size_m, len(measured))
    sigma_m = sigma_z * slope
    return CloudFrame(
        stamp_ns=stamp_ns,
        points_m=given_rays * measured[:, None],
        normals=normals,
        sigma_m=sigma_m,
        planarity_m=sigma_m,
        bias_m=np.zeros(len(sigma_m)),
    )


def cylinders(world: World) -> list[CylinderSighting]:
    """The pipe as fitted to the Kinect's cloud, where nothing hides it; at the end, when the pipe is known."""
    if world.scenario.clouds.frames == 0 or not world.scenario.clouds.cylinder:
        return []
    pipe, b_T_w = world.scene.pipe, invert(world.scene.w_T_b)
    ends_w = pipe.base + np.array([[0.8], [1.5]]) * pipe.axis
    eyes = np.tile(world.scene.w_T_b[:3, 3], (2, 1))
    if occluded(eyes, ends_w, world.scene.surfaces).any():
        return []
    ends = transform(b_T_w, ends_w)
    across = across_axis(b_T_w[:3, :3] @ pipe.axis)
    E = np.zeros((7, 5))
    E[:3, :2] = E[3:6, 2:4] = across.T
    E[6, 4] = 1.0
    covariance = np.diag([0.0, 0.0, 0.0, 0.0, CYLINDER_RADIUS_SIGMA_M**2])
    for i, end in enumerate(ends):
        view = across @ (end / np.linalg.norm(end))
        along = np.hypot(kinect_sigma_m(end[2]), SMOOTH_SHARE * end[2])
        rows = slice(2 * i, 2 * i + 2)
        covariance[rows, rows] = CYLINDER_ACROSS_SIGMA_M**2 * np.eye(2) + along**2 * np.outer(view, view)
    response = np.vstack([*depth_moves(ends), np.zeros((1, 5))])
    true = world.true
    states = np.array([true.depth_offset_m, true.depth_scale, *true.depth_rays])
    noise = world.rng.spawn(1)[0].multivariate_normal(np.zeros(5), covariance) * world.scenario.noise_factors.clouds
    fitted = np.array([*ends[0], *ends[1], pipe.radius_m]) - response @ states + E @ noise
    information = E @ np.linalg.inv(covariance) @ E.T
    return [
        CylinderSighting(
            world.stamps_ns[-1], "b_depth", world.rig.pipes[0].id, fitted[:3], fitted[3:6], float(fitted[6]),
            information, 3000, 0.0015, "kinect_cloud", response,
        )
    ]  # fmt: skip


def kinect_sigma_m(depth_m: Float) -> Float:
    """Axial noise of a Kinect v1 (Nguyen, Izadi, Lovell 2012), standard deviation in m."""
    return 0.0012 + 0.0019 * (depth_m - 0.4) ** 2


def clicks(world: World) -> list[Pick | OutlineSighting]:
    """At every place, on every named point: clicks, and the pipe's outline round them."""
    found: list[Pick | OutlineSighting] = []
    for stamp_ns in world.place_stamps_ns:
        w_T_m = world.w_T_m[world.stamps_ns.index(stamp_ns)]
        for (point_id, point_w), role in zip(world.points_w.items(), world.scenario.picks.roles, strict=True):
            pixels, depth_m = project(world.true.cameras["m_left"], w_T_m, point_w[None])
            if depth_m[0] < 0.3 or not inside(pixels, world.true.cameras["m_left"], 3.0)[0]:
                continue
            if occluded(w_T_m[None, :3, 3], point_w[None], world.scene.surfaces)[0]:
                continue
            found += [_pick(world, stamp_ns, point_id, role, pixels[0]) for _ in range(world.scenario.picks.clicks)]
            if world.scenario.picks.outlines and role != "other":
                outline = _outline(world, stamp_ns, w_T_m, pixels[0])
                found += [outline] if outline is not None else []
    return found


def stereo_clicks(world: World, picks: list[Pick]) -> list[ClickedPoint]:
    """What a stereo matcher says under each click: the visible surface, with the calibration as given.

    For the paper's chain only; the estimator is not given it.
    """
    return [_stereo_click(world, pick) for pick in picks]


def _stereo_click(world: World, pick: Pick) -> ClickedPoint:
    scenario, rng = world.scenario, world.rng
    left, right = world.true.cameras["m_left"], world.true.cameras["m_right"]
    w_T_m = world.w_T_m[world.stamps_ns.index(pick.stamp_ns)]
    ray = w_T_m[:3, :3] @ np.linalg.solve(left.K, np.array([*pick.px, 1.0]))
    distance, _, _ = cast(w_T_m[:3, 3], ray[None], world.scene)
    if not np.isfinite(distance[0]):
        return ClickedPoint(pick, None, "no surface under the click")
    surface_w = w_T_m[:3, 3] + distance[0] * ray
    seen, _ = project(right, w_T_m @ world.true.m_left_T_m_right, surface_w[None])
    disparity_px = pick.px[0] - seen[0, 0] + rng.normal(0.0, MATCH_SIGMA_PX)
    if disparity_px <= 0.5:
        return ClickedPoint(pick, None, "no stereo depth at the click")
    K = world.nominal["m_left"].K
    depth_m = K[0, 0] * scenario.baseline_m / disparity_px
    return ClickedPoint(pick, depth_m * np.linalg.solve(K, np.array([*pick.px, 1.0])))


def _pick(world: World, stamp_ns: int, point_id: str, role: str, exact_px: Float) -> Pick:
    settings, rng = world.scenario.picks, world.rng
    # No click is better than the model's floor, and a campaign draws what the models say.
    sigma_px = max(settings.sigma_px, world.rig.noise.pick_floor_px)
    px = exact_px + rng.normal(0.0, sigma_px * world.scenario.noise_factors.picks, 2)
    if "picks" in world.scenario.outliers.families:
        px = spoil(px[None], world.scenario.outliers, world.outlier_rng)[0]
    covariance = settings.sigma_px**2 * np.eye(2)
    return Pick(stamp_ns, "m_left", point_id, role, px, px, covariance)  # pyright: ignore[reportArgumentType]


def _outline(world: World, stamp_ns: int, w_T_m: Float, pick_px: Float) -> OutlineSighting | None:
    """The two true edges, each shifted and turned by noise about its foot near the click."""
    camera, rng, pipe = world.true.cameras["m_left"], world.rng, world.scene.pipe
    m_T_w = invert(w_T_m)
    visible_m = pipe.radius_m * (1.0 - world.inset)
    lines = outline_lines(transform(m_T_w, pipe.base), m_T_w[:3, :3] @ pipe.axis, visible_m, camera.K)
    if lines is None:
        return None
    half_px = 0.25 * camera.height
    offset_sigma = world.scenario.picks.outline_sigma_px / np.sqrt(half_px)
    sigmas = np.array([offset_sigma, offset_sigma * np.sqrt(3.0) / half_px])
    noisy, feet, extents = np.empty((2, 3)), np.empty((2, 2)), np.empty((2, 2, 2))
    for i, line in enumerate(lines):
        feet[i] = pick_px - (line @ np.r_[pick_px, 1.0]) * line[:2]
        spread = np.array([np.hypot(sigmas[0], EDGE_FLOOR_PX), sigmas[1]])
        shift, turn = rng.normal(0.0, spread * world.scenario.noise_factors.outlines)
        shift += _edge_outlier_px(world)
        noisy[i] = _moved_line(line, feet[i], shift, turn)
        along = np.array([-noisy[i, 1], noisy[i, 0]])
        extents[i] = feet[i] + np.outer([-half_px, half_px], along)
    return OutlineSighting(
        stamp_ns=stamp_ns,
        camera="m_left",
        pipe_id=world.rig.pipes[0].id,
        lines=noisy,
        covariance=np.tile(np.diag(sigmas**2), (2, 1, 1)),
        foot_px=feet,
        extent_px=extents,
        pick_px=pick_px,
        quality=1.0,
    )


def _edge_outlier_px(world: World) -> float:
    """What a gross error adds to the place of an edge."""
    outliers, rng = world.scenario.outliers, world.outlier_rng
    if "outlines" not in outliers.families or rng.random() >= outliers.share:
        return 0.0
    return float(rng.uniform(-1.0, 1.0)) * outliers.size_px


def _moved_line(line: Float, foot_px: Float, shift_px: float, turn_rad: float) -> Float:
    """A line moved along its normal and turned about the foot."""
    c, s = np.cos(turn_rad), np.sin(turn_rad)
    normal = np.array([c * line[0] - s * line[1], s * line[0] + c * line[1]])
    return np.r_[normal, -normal @ (foot_px + shift_px * line[:2])]
