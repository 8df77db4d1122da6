"""Measurements to the engine: the graph's half of the loop, the same for offline and streaming runs."""

from collections.abc import Iterable, Iterator

from ..factors.errors import LogError, ObservabilityError
from ..factors.rig import Rig
from ..frontends.fiducials.messages import UNKNOWN_IDS
from .base_search import BaseSearch
from .bundle import Bundle
from .depth_search import DepthSearch
from .engine import Engine
from .outline_search import OutlineSearch
from .sensing import Sensed, SensingReport
from .surfaces import Associator, lay_on_surfaces


class Pipeline:
    """Feeds one engine with what the front ends see, and looks for pipes where the engine expects them."""

    def __init__(
        self,
        rig: Rig,
        associate: Associator = lay_on_surfaces,
        together: int = 1,
    ) -> None:
        self.rig = rig
        self.engine = Engine(rig, {}, associate, together=together)
        self._outlines = OutlineSearch(self.engine)
        self._depths = DepthSearch(self.engine)
        self._base = BaseSearch(self.engine)

    def run(self, seen: Iterable[Sensed]) -> Iterator[int]:
        """Takes what the front ends see in the order of time; yields each stamp (ns) when it has been worked in."""
        for sensed in seen:
            self.take(sensed)
            yield sensed.stamp_ns

    def take(self, sensed: Sensed) -> None:
        """Everything of one stamp."""
        engine = self.engine
        engine.cameras.update(sensed.cameras)
        engine.add(sensed.bundle)
        if sensed.atlas is not None:
            engine.album.add(sensed.atlas, engine.odometry.observations.keys())
        engine.pick_images.update(sensed.clicked)
        if sensed.pair is not None and sensed.stamp_ns in engine.keyframe_at:
            self._outlines.see(sensed.pair, sensed.bundle.picks)
            self._base.see(sensed.pair)
        elif sensed.bundle.frame is not None:  # counted by frames: how a stream splits a moment must not matter
            self._outlines.go_on()
        if sensed.depth is not None:
            engine.add(Bundle(sensed.stamp_ns, cloud=sensed.depth.cloud, moved=sensed.depth.moved))
            self._depths.see(sensed.depth)
            self._base.search(sensed.depth)

    def look_back(self, sensed: Sensed) -> bool:
        """Clicks in a frame that was taken in before: it becomes a keyframe. False where that is too late."""
        if not self.engine.promote(sensed.bundle) or sensed.pair is None:
            return False
        self.engine.pick_images.update(sensed.clicked)
        self.engine.take_picks(sensed.bundle)
        self._outlines.see(sensed.pair, sensed.bundle.picks)
        return True

    def complete(self) -> None:
        """What waited for something else gets its last chance."""
        self._outlines.go_on(to_the_end=True)
        self.engine.revisit()
        self._outlines.complete()
        if self._base.search(self._depths.view, last=True):
            self.engine.revisit()
        self._depths.begin_unknown()
        self._depths.search()

    def check(self, report: SensingReport) -> None:
        """After the last message: is there anything to estimate from, and was everything understood?

        Raises:
            LogError: a pick without depth or second view, or on a camera that never delivered.
            ObservabilityError: a pick in a camera that nothing places.
        """
        self.complete()
        self._check_ids(report)
        pairing = report.pairing
        if pairing.pairs == 0 and pairing.unpaired and not self.engine.odometry.keyframe_stamps:
            counts = ", ".join(f"{topic} {count}" for topic, count in sorted(pairing.unpaired.items()))
            raise LogError(
                f"no stereo pair: stamps of left and right never agree ({counts} images); synchronise the cameras"
            )
        for name, point in self.engine.pipes.points.items():
            if not point.known:
                pick = point.held[-1][1]
                raise LogError(
                    f"{self.rig.picks_topic} at {pick.stamp_ns} ns: pick {name} in {pick.camera} has no depth and no "
                    "second view; pick the point again from another place"
                )
        self._check_open_picks()

    def _check_ids(self, report: SensingReport) -> None:
        """Markers were seen, and none of them is on a board."""
        if self.engine.odometry.keyframe_stamps:
            return
        for refused in report.rejected:
            if refused.reason.startswith(UNKNOWN_IDS):
                raise LogError(
                    f"no known marker was seen: at {refused.stamp_ns} ns {refused.what} are on no board of the rig; "
                    "correct dictionary and marker ids in the rig file"
                )

    def _check_open_picks(self) -> None:
        """A point all of whose picks hang on nothing."""
        for pick in self.engine.lost_picks():
            engine = self.engine
            if pick.point_id in engine.pipes.points or not engine.odometry.keyframe_stamps:
                continue
            if pick.stamp_ns in engine.keyframe_at and pick.camera != "b_rgb":
                continue  # made while the camera was lost, which the result says
            where = f"{self.rig.picks_topic} at {pick.stamp_ns} ns: pick {pick.point_id} in {pick.camera}"
            if pick.camera == "b_rgb":
                raise ObservabilityError(f"{where}: {self.engine.why_no_base()}")
            raise LogError(
                f"{where} has the stamp of no image or markers that could be placed; a pick's header.stamp is that of "
                "the image it was made in"
            )
