"""The paper's own method: a clicked point through a chain of single measurements, equations (1) to (14).

Burrell et al., "Towards a Cooperative Robotic System for Autonomous Pipe Cutting in Nuclear Decommissioning",
section III. Kept as the record and the baseline: it gives a position and no covariance. The names follow the paper:
`D`, `D_hat`, `S`, `M`, `F`, `B` and `P{m} -> P{o} -> P{f} -> P{b}`.

What the paper leaves open is decided here as follows. The board is used in the first image in which it is seen. Its
pose comes from ONE marker (`choice="one_marker"`, the one that the rig lists first among those seen), or from the mean
of the poses that the single markers give to the page (`choice="mean"`). Positions are corrected with S (4),
orientations cannot be. The mobile camera's pose is the chain of the odometry's frame to frame motions.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from ..factors.errors import ObservabilityError, RigError
from ..factors.measurements import Pick, StereoFrame
from ..factors.rig import Board, Marker, Pose, Rig

Float = NDArray[np.float64]
BoardChoice = Literal["one_marker", "mean"]


@dataclass(frozen=True, slots=True)
class BoardView:
    """What one image says about one board: every marker by itself."""

    stamp_ns: int
    board: str
    markers: tuple[int, ...]
    m_T_marker: Float
    """Shape (n, 4, 4), each from the four corners of that marker alone and the side length as given."""


@dataclass(frozen=True, slots=True)
class ClickedPoint:
    """A click with the depth that the stereo pair gives there."""

    pick: Pick
    position_m: Float | None
    """Shape (3,), in {m} at the click, on the surface; None where the pair has no depth there."""
    reason: str = ""


@dataclass(frozen=True, slots=True)
class ChainPoint:
    """The paper's answer for one click."""

    point_id: str
    role: str
    stamp_ns: int
    position_b_m: Float | None
    """Shape (3,), in {b}; None where the chain has no answer."""
    reason: str = ""


@dataclass(frozen=True, slots=True)
class Chain:
    """The links of the chain that are common to all clicks."""

    scale: float
    """S of equation (9)."""
    o_T_f: Float
    """Shape (4, 4), F: rotation and corrected translation."""
    f_T_b: Float
    """Shape (4, 4), the tape measurement."""


def page_distances(centres_m: Float) -> Float:
    """Known distances between marker centres, equations (1) and (2): shape (n, 2) on the page to (n, n), in m."""
    return np.linalg.norm(centres_m[:, None] - centres_m[None], axis=2)


def measured_distances(centres_c_m: Float) -> Float:
    """Distances between measured centres, equations (3) and (5): shape (n, 3) in the camera to (n, n), in m."""
    return np.linalg.norm(centres_c_m[:, None] - centres_c_m[None], axis=2)


def scale_factors(known_m: Float, measured_m: Float) -> Float:
    """Element by element quotient of the distances, equations (7) and (8); zeros on the diagonal. Shape (n, n)."""
    off_diagonal = ~np.eye(len(known_m), dtype=bool)
    factors = np.zeros_like(known_m)
    np.divide(known_m, measured_m, out=factors, where=off_diagonal)
    return factors


def scale(factors: Float) -> float:
    """The scalar S: mean of the off-diagonal elements, equation (9). One marker has no distance: S = 1."""
    n = len(factors)
    return float(factors.sum() / (n * n - n)) if n > 1 else 1.0


def corrected_centres(scale_factor: float, centres_c_m: Float) -> Float:
    """Positions times S, equation (4) (and with it (6)). Shape (n, 3)."""
    return scale_factor * centres_c_m


def rodrigues(rotation_vector_rad: Float) -> Float:
    """Rotation matrix of a rotation vector, equation (12).

    The paper prints the axis and the vector with one symbol: in its formula r_F is the unit axis, in theta = |r_F| it
    is the vector itself.
    """
    theta = float(np.linalg.norm(rotation_vector_rad))
    if theta == 0.0:
        return np.eye(3)
    x, y, z = axis = rotation_vector_rad / theta
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.cos(theta) * np.eye(3) + (1.0 - np.cos(theta)) * np.outer(axis, axis) + np.sin(theta) * cross


def origin_from_mobile(o_T_m: Float, m_point: Float) -> Float:
    """P{o} = R_M P{m} + T_M, equation (11), with M of (10) as a matrix."""
    return o_T_m[:3, :3] @ m_point + o_T_m[:3, 3]


def fiducial_from_origin(o_T_f: Float, o_point: Float) -> Float:
    """P{f} = R_F^-1 (P{o} - T_F), equation (13).

    The paper prints R_M^-1 P{o} - T_M: the symbols of the mobile camera in place of the fiducial's, and the translation
    outside the rotation. Neither undoes the pose F of the fiducial in {o}; this form does.
    """
    return o_T_f[:3, :3].T @ (o_point - o_T_f[:3, 3])


def base_from_fiducial(b_T_f: Float, f_point: Float) -> Float:
    """P{b} = R_B P{f} + T_B, equation (14)."""
    return b_T_f[:3, :3] @ f_point + b_T_f[:3, 3]


def board_scale(view: BoardView, board: Board) -> float:
    """S from one view of a board, equations (1) to (9)."""
    centres_m = np.array([_marker(board, i).centre_m for i in view.markers])
    return scale(scale_factors(page_distances(centres_m), measured_distances(view.m_T_marker[:, :3, 3])))


def board_pose(view: BoardView, board: Board, scale_factor: float, choice: BoardChoice = "one_marker") -> Float:
    """Pose of the page in the camera, `m_T_f`, with positions corrected by S (4). Shape (4, 4)."""
    m_T_marker = view.m_T_marker.copy()
    m_T_marker[:, :3, 3] = corrected_centres(scale_factor, m_T_marker[:, :3, 3])
    pages = np.array(
        [m_T_marker[row] @ invert(marker_on_page(_marker(board, number))) for row, number in enumerate(view.markers)]
    )
    if choice == "mean":
        return mean_pose(pages)
    listed = [marker.id for marker in board.markers]
    return pages[min(range(len(view.markers)), key=lambda row: listed.index(view.markers[row]))]


def mean_pose(poses: Float) -> Float:
    """Mean translation, and the rotation nearest to the mean of the matrices. Shape (n, 4, 4) to (4, 4)."""
    u, _, vt = np.linalg.svd(poses[:, :3, :3].mean(axis=0))
    mean = np.eye(4)
    mean[:3, :3] = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    mean[:3, 3] = poses[:, :3, 3].mean(axis=0)
    return mean


def odometry_chain(frames: Sequence[StereoFrame]) -> dict[int, Float]:
    """M of equation (10) for every frame: stamp in ns to `o_T_m`, the first frame being {o}. Shape (4, 4) each."""
    poses: dict[int, Float] = {}
    o_T_m = np.eye(4)
    for index, frame in enumerate(frames):
        if index:
            o_T_m = o_T_m @ frame.last_T_this
        poses[frame.stamp_ns] = o_T_m
    return poses


def build_chain(view: BoardView, o_T_m: Mapping[int, Float], rig: Rig, choice: BoardChoice = "one_marker") -> Chain:
    """F and B from the first view of the mount's board.

    Raises:
        RigError: the rig has no mount.
        ObservabilityError: there is no odometry.
    """
    if rig.mount is None:
        raise RigError("rig: the chain needs the mount f_T_b; add the section mount")
    board = next(board for board in rig.boards if board.id == view.board)
    factor = board_scale(view, board)
    o_T_f = _pose_at(o_T_m, view.stamp_ns) @ board_pose(view, board, factor, choice)
    return Chain(scale=factor, o_T_f=o_T_f, f_T_b=pose_matrix(rig.mount.f_T_b))


def carry(chain: Chain, o_T_m: Mapping[int, Float], click: ClickedPoint) -> ChainPoint:
    """One click through the chain, equations (11), (13), (14)."""
    pick = click.pick
    if click.position_m is None:
        return ChainPoint(pick.point_id, pick.role, pick.stamp_ns, None, click.reason)
    o_point = origin_from_mobile(_pose_at(o_T_m, pick.stamp_ns), click.position_m)
    b_point = base_from_fiducial(invert(chain.f_T_b), fiducial_from_origin(chain.o_T_f, o_point))
    return ChainPoint(pick.point_id, pick.role, pick.stamp_ns, b_point)


def paper_chain(
    view: BoardView | None,
    frames: Sequence[StereoFrame],
    clicks: Sequence[ClickedPoint],
    rig: Rig,
    choice: BoardChoice = "one_marker",
) -> tuple[ChainPoint, ...]:
    """The paper's method on one recording.

    Args:
        view: the first view of the mount's board in the left mobile camera.
        frames: the odometry, every frame, sorted by stamp; the first one is {o}.
        clicks: operator clicks with their stereo depth.
        rig: boards and mount.
        choice: which marker gives the orientation, see the head of this file.

    Raises:
        ObservabilityError: the board was never seen, or there is no odometry.
        RigError: the rig has no mount.
    """
    if view is None:
        raise ObservabilityError("the paper's chain has no link from {o} to {f}: the board was never seen by m_left")
    o_T_m = odometry_chain(frames)
    chain = build_chain(view, o_T_m, rig, choice)
    return tuple(carry(chain, o_T_m, click) for click in clicks)


def click_from_tracks(pick: Pick, frame: StereoFrame, K: Float, baseline_m: float, count: int = 5) -> ClickedPoint:
    """Depth at a click from the stereo tracks near it: for recordings that hold tracks and no images.

    Median disparity of the `count` tracks nearest in the image, for a pair whose axes are parallel.

    Args:
        pick: the click, ideal pixels of the left camera.
        frame: the tracks of the same stamp.
        K: left intrinsics, shape (3, 3).
        baseline_m: distance of the two cameras.
        count: number of tracks.
    """
    paired = np.isfinite(frame.right_px).all(axis=1)
    left_px, right_px = frame.left_px[paired], frame.right_px[paired]
    nearest = np.argsort(np.linalg.norm(left_px - pick.px, axis=1))[:count]
    disparity_px = float(np.median(left_px[nearest, 0] - right_px[nearest, 0])) if len(nearest) else 0.0
    if disparity_px <= 0.0:
        return ClickedPoint(pick, None, "no stereo depth near the click")
    ray = np.linalg.solve(K, np.array([pick.px[0], pick.px[1], 1.0]))
    return ClickedPoint(pick, ray * (K[0, 0] * baseline_m / disparity_px))


def behind_surface(click: ClickedPoint, radius_m: float) -> ClickedPoint:
    """The click moved from the pipe's surface to its axis, along the ray, where the pipe's radius is known.

    The paper clicks surfaces on both sides of its comparison; here `cut` and `grasp` name the axis, and without this
    step the baseline would be charged with a radius that it never claimed to know.
    """
    if click.position_m is None or click.pick.role == "other":
        return click
    distance_m = float(np.linalg.norm(click.position_m))
    return ClickedPoint(click.pick, click.position_m * (1.0 + radius_m / distance_m), click.reason)


def marker_on_page(marker: Marker) -> Float:
    """`f_T_marker`, shape (4, 4)."""
    c, s = np.cos(marker.rotation_rad), np.sin(marker.rotation_rad)
    matrix = np.eye(4)
    matrix[:2, :2] = [[c, -s], [s, c]]
    matrix[:2, 3] = marker.centre_m
    return matrix


def pose_matrix(pose: Pose) -> Float:
    """A pose of the rig file as a matrix, by (12). Shape (4, 4)."""
    matrix = np.eye(4)
    matrix[:3, :3] = rodrigues(np.array(pose.rotation_vector_rad))
    matrix[:3, 3] = pose.translation_m
    return matrix


def invert(a_T_b: Float) -> Float:
    """`b_T_a`, shape (4, 4)."""
    b_T_a = np.eye(4)
    b_T_a[:3, :3] = a_T_b[:3, :3].T
    b_T_a[:3, 3] = -a_T_b[:3, :3].T @ a_T_b[:3, 3]
    return b_T_a


def _marker(board: Board, number: int) -> Marker:
    return next(marker for marker in board.markers if marker.id == number)


def _pose_at(o_T_m: Mapping[int, Float], stamp_ns: int) -> Float:
    """The odometry's pose at the stamp, or at the frame nearest in time."""
    if not o_T_m:
        raise ObservabilityError("the paper's chain has no link from {m} to {o}: there is no stereo odometry")
    return o_T_m[min(o_T_m, key=lambda stamp: abs(stamp - stamp_ns))]
