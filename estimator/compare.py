"""The paper's chain on a recording: what its single measurements are, taken from the same messages as the estimate."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..factors.camera import CameraModel
from ..factors.errors import RigError
from ..factors.measurements import MarkerSighting, Pick, StereoFrame
from ..factors.rig import Board, Rig
from ..frontends.paper_chain import clicked_point, marker_pose, plain_sightings
from ..io.messages import DetectionsBody, Message, PickBody
from ..io.pairing import StereoPair
from .baseline import BoardChoice, BoardView, ChainPoint, ClickedPoint, behind_surface, paper_chain
from .sensing import Item, Sensing, images
from .sensors import PairImages

Float = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class ChainInput:
    """The single measurements that the chain is made of."""

    view: BoardView | None
    frames: tuple[StereoFrame, ...]
    clicks: tuple[ClickedPoint, ...]


def chain_of_messages(
    messages: Iterable[Message], rig: Rig, choice: BoardChoice = "one_marker"
) -> tuple[ChainPoint, ...]:
    """The paper's answer for every click of a recording.

    Raises:
        RigError: the rig has no mount.
        ObservabilityError: the board was never seen, or there is no odometry.
        LogError: the recording lacks a calibration, or holds a click that cannot be.
    """
    found = gather(messages, rig)
    return paper_chain(found.view, found.frames, found.clicks, rig, choice)


def gather(messages: Iterable[Message], rig: Rig) -> ChainInput:
    """Reads the recording once: odometry of every pair, the board's first image, depth at the clicks."""
    if rig.mount is None:
        raise RigError("rig: the chain needs the mount f_T_b; add the section mount")
    collector = _Collector(rig, mount_board(rig))
    for group in collector.groups(messages):
        collector.collect(group)
    return ChainInput(collector.view, tuple(collector.frames), tuple(collector.clicks))


def mount_board(rig: Rig) -> Board:
    """The board that the mount is measured from."""
    if rig.mount is None:
        raise RigError("rig: the chain needs the mount f_T_b; add the section mount")
    name = rig.mount.board
    return next(board for board in rig.boards if board.id == name)


def board_view(sightings: Iterable[MarkerSighting], board: Board, left: CameraModel, stamp_ns: int) -> BoardView | None:
    """Every marker of the board in one image of the left camera, each with its own pose; None without one."""
    poses = {
        sighting.marker: marker_pose(sighting, left, board.side_m)
        for sighting in sightings
        if sighting.camera == "m_left" and sighting.board == board.id
    }
    solved = {marker: pose for marker, pose in poses.items() if pose is not None}
    return BoardView(stamp_ns, board.id, tuple(solved), np.array(list(solved.values()))) if solved else None


def pipe_radius_m(rig: Rig, point_id: str) -> float:
    """Half the nominal diameter of the pipe that a point is on; 0 where the rig file gives none."""
    for pipe in rig.pipes:
        if (not pipe.points or point_id in pipe.points) and pipe.nominal_diameter_m is not None:
            return 0.5 * pipe.nominal_diameter_m
    return 0.0


class _Collector(Sensing):
    """The estimator's own reading of a log, kept as the chain's single measurements."""

    def __init__(self, rig: Rig, board: Board) -> None:
        super().__init__(rig)
        self.view: BoardView | None = None
        self.frames: list[StereoFrame] = []
        self.clicks: list[ClickedPoint] = []
        self._board = board

    def collect(self, group: list[Item]) -> None:
        """All messages of one stamp."""
        self.calibrate(group)
        pair = next((images(item) for item in group if isinstance(item, StereoPair)), None)
        if pair is not None:
            self.frames.append(self.sensors.track(pair))
        if self.view is None:
            self.view = self._first_view(group, pair)
        for item in group:
            if isinstance(item, Message) and isinstance(item.body, PickBody):
                self.clicks.append(self._click(self.sensors.pick(item.stamp_ns, item.body), pair))

    def _first_view(self, group: list[Item], pair: PairImages | None) -> BoardView | None:
        sightings = []
        if pair is not None and "m_left" in self.sensors.cameras:
            camera = self.sensors.cameras["m_left"]
            sightings = plain_sightings(pair.stamp_ns, pair.left, self._board, camera)
        for item in group:
            if isinstance(item, Message) and isinstance(item.body, DetectionsBody):
                camera = self.camera_of(item.topic)
                if camera == "m_left":
                    sightings = [*sightings, *self.sensors.detections(camera, item.stamp_ns, item.body)]
        if not sightings:
            return None
        return board_view(sightings, self._board, self.sensors.cameras["m_left"], group[0].stamp_ns)

    def _click(self, pick: Pick, pair: PairImages | None) -> ClickedPoint:
        if pick.camera != "m_left":
            return ClickedPoint(pick, None, f"the chain clicks in m_left only, this click is in {pick.camera}")
        if pair is None:
            return ClickedPoint(pick, None, "there is no stereo pair of the click's stamp")
        cameras = self.sensors.cameras
        point = clicked_point(pair.left, pair.right, cameras["m_left"], cameras["m_right"], pick.raw_px)
        if point is None:
            return ClickedPoint(pick, None, "stereo matching has no depth at the click")
        return behind_surface(ClickedPoint(pick, point), pipe_radius_m(self.rig, pick.point_id))
