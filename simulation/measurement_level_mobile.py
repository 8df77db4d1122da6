"""What the mobile pair measures: feature tracks and marker corners."""

import numpy as np
from numpy.typing import NDArray

from ..estimator.view_cells import ViewCells
from ..factors.measurements import MarkerSighting, StereoFrame
from .measurement_level_board import corners_on_page, inwards, knocked
from .measurement_level_scenario import BoardFaults
from .measurement_level_scene import occluded
from .measurement_level_truth import Float, TrueCamera, invert, matrix, transform
from .measurement_level_world import World, inside, project, spoil

Bool = NDArray[np.bool_]


def stereo_frames(world: World) -> list[StereoFrame]:
    """Tracks that live while their point is in view, for a random time; a point seen again gets a new id."""
    settings, rng, scene = world.scenario.tracks, world.rng, world.scene
    track_of = np.full(len(scene.landmarks), -1)
    next_id, frames, motion_start = 0, [], world.w_T_m[0]
    for index, (stamp_ns, w_T_m) in enumerate(zip(world.stamps_ns, world.w_T_m, strict=True)):
        left_px, seen = _landmarks_in_view(world, w_T_m)
        lives = (track_of >= 0) & seen & (rng.random(len(seen)) > 1.0 / settings.mean_life_frames)
        track_of[~lives] = -1
        free = np.flatnonzero(seen & ~lives)
        new = rng.permutation(free)[: max(0, settings.per_frame - int(lives.sum()))]
        track_of[new] = next_id + np.arange(len(new))
        next_id += len(new)
        rows = np.flatnonzero(track_of >= 0)
        last_T_this = _noisy_motion(world, motion_start, w_T_m) if index else np.eye(4)
        motion_start = w_T_m
        frames.append(_stereo_frame(world, stamp_ns, w_T_m, track_of[rows], left_px[rows], rows, last_T_this, lives))
    return frames


def _stereo_frame(
    world: World,
    stamp_ns: int,
    w_T_m: Float,
    ids: np.ndarray,
    left_px: Float,
    rows: np.ndarray,
    last_T_this: Float,
    lives: np.ndarray,
) -> StereoFrame:
    settings, rng = world.scenario.tracks, world.rng
    n = len(rows)
    right_px, _ = project(
        world.true.cameras["m_right"], w_T_m @ world.true.m_left_T_m_right, world.scene.landmarks[rows]
    )
    right = world.true.cameras["m_right"]
    found = inside(right_px, right) & (rng.random(n) < settings.right_share)
    sigma_px = settings.sigma_px * world.scenario.noise_factors.tracks
    left_px = left_px + rng.normal(0.0, sigma_px, (n, 2))
    right_px = right_px + rng.normal(0.0, sigma_px, (n, 2))
    if "tracks" in world.scenario.outliers.families:
        left_px = spoil(left_px, world.scenario.outliers, world.outlier_rng)
        right_px = spoil(right_px, world.scenario.outliers, world.outlier_rng)
    covariance = np.tile(settings.sigma_px**2 * np.eye(2), (n, 1, 1))
    connected = int(lives.sum())
    first = stamp_ns == world.stamps_ns[0]
    return StereoFrame(
        stamp_ns=stamp_ns,
        is_keyframe=True,
        track_ids=ids.astype(np.int64),
        left_px=left_px,
        left_covariance_px2=covariance,
        right_px=np.where(found[:, None], right_px, np.nan),
        right_covariance_px2=covariance,
        last_T_this=last_T_this,
        motion_inliers=0 if first else connected,
        lost=not first and connected < 8,
    )


def _noisy_motion(world: World, w_T_last: Float, w_T_this: Float) -> Float:
    settings, rng = world.scenario.tracks, world.rng
    noise = matrix(rng.normal(0.0, settings.motion_sigma_rad, 3), rng.normal(0.0, settings.motion_sigma_m, 3))
    motion = invert(w_T_last) @ w_T_this
    # Depth from a pair whose baseline is taken too long or too short stretches every step.
    motion[:3, 3] *= world.scenario.baseline_m / np.linalg.norm(world.true.m_left_T_m_right[:3, 3])
    return motion @ noise


def _landmarks_in_view(world: World, w_T_m: Float) -> tuple[Float, np.ndarray]:
    """Exact pixels of all landmarks, shape (n, 2), and which of them the left camera sees."""
    scene = world.scene
    pixels, depth_m = project(world.true.cameras["m_left"], w_T_m, scene.landmarks)
    rays = scene.landmarks - w_T_m[:3, 3]
    distance_m = np.linalg.norm(rays, axis=1)
    facing = -(rays * scene.landmark_normals).sum(1) / distance_m > 0.15
    seen = (depth_m > 0.35) & (distance_m < 5.0) & facing & inside(pixels, world.true.cameras["m_left"], 4.0)
    rows = np.flatnonzero(seen)
    eyes = np.tile(w_T_m[:3, 3], (len(rows), 1))
    seen[rows[occluded(eyes, scene.landmarks[rows], scene.surfaces, scene.pipe)]] = False
    return pixels, seen


def marker_sightings(world: World) -> list[MarkerSighting]:
    """All markers in all images of the mobile pair: whole in the image, large enough, not too oblique."""
    sightings = []
    for name, m_T_camera in (("m_left", np.eye(4)), ("m_right", world.true.m_left_T_m_right)):
        common: dict[tuple[str, int, int], Float] = {}
        cells = {board: ViewCells() for board in world.true.boards}
        for stamp_ns, w_T_m in zip(world.stamps_ns, world.w_T_m, strict=True):
            for page in world.true.boards.values():
                faults = world.scenario.board if page.id == world.rig.boards[0].id else BoardFaults()
                seconds = 1e-9 * (stamp_ns - world.stamps_ns[0])
                w_T_f = knocked(world.w_T_f[page.id], faults, seconds)
                # Views from one place share a part of their error, and what one place is the model says.
                cells[page.id].count(stamp_ns, invert(w_T_f) @ w_T_m)
                for marker, corners_f in corners_on_page(page, faults, seconds).items():
                    corners_w = transform(w_T_f, corners_f)
                    exact_px = _whole_marker(world, world.true.cameras[name], w_T_m @ m_T_camera, corners_w)
                    if exact_px is None:
                        continue
                    place = (page.id, marker, cells[page.id].cell)
                    if place not in common:
                        common[place] = world.rng.normal(0.0, world.rig.noise.marker_common_px, (4, 2))
                    found_px = inwards(exact_px, faults.inset_px) + common[place]
                    sightings.append(_sighting(world, stamp_ns, name, page.id, marker, found_px))
    return sightings


def _sighting(world: World, stamp_ns: int, name: str, board: str, marker: int, exact_px: Float) -> MarkerSighting:
    settings, factors, rng = world.scenario.markers, world.scenario.noise_factors, world.rng
    corners_px = exact_px + rng.normal(0.0, settings.sigma_px * factors.markers, (4, 2))
    if "markers" in world.scenario.outliers.families:
        corners_px = spoil(corners_px, world.scenario.outliers, world.outlier_rng)
    covariance = np.tile(settings.sigma_px**2 * np.eye(2), (4, 1, 1))
    return MarkerSighting(stamp_ns, name, board, marker, corners_px, covariance, corners_px)  # pyright: ignore[reportArgumentType]


def _whole_marker(world: World, camera: TrueCamera, w_T_camera: Float, corners_w: Float) -> Float | None:
    pixels, depth_m = project(camera, w_T_camera, corners_w)
    if depth_m.min() < 0.1 or not inside(pixels, camera, 2.0).all():
        return None
    normal = np.cross(corners_w[1] - corners_w[0], corners_w[3] - corners_w[0])
    ray = w_T_camera[:3, 3] - corners_w.mean(axis=0)
    cosine = float(normal @ ray / (np.linalg.norm(normal) * np.linalg.norm(ray)))
    sides_px = np.linalg.norm(pixels - np.roll(pixels, 1, axis=0), axis=1)
    if cosine < 0.35 or sides_px.min() < world.scenario.markers.smallest_side_px:
        return None
    hidden = occluded(w_T_camera[None, :3, 3], corners_w.mean(axis=0)[None], world.scene.surfaces)
    return None if hidden[0] else pixels
