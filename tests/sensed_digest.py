"""What the front ends see in a recording, in one line; run alone, as copies of a process see it."""

import hashlib
import sys
from pathlib import Path


def digest(recording) -> str:
    """Of stamps, tracks, corners, depth and clicks, and of the report."""
    total = hashlib.sha256()
    for sensed in recording:
        frame, view = sensed.bundle.frame, sensed.depth
        arrays = [] if frame is None else [frame.track_ids, frame.left_px, frame.right_px, frame.last_T_this]
        arrays += [sighting.corners_px for sighting in sensed.bundle.sightings]
        arrays += [] if view is None else [view.cloud.points_m, view.colour]
        arrays += [] if sensed.pair is None else [sensed.pair.left, sensed.pair.right]
        total.update(repr((sensed.stamp_ns, sorted(sensed.cameras), sorted(sensed.clicked))).encode())
        for array in arrays:
            total.update(b"none" if array is None else array.tobytes())
    total.update(repr(recording.report).encode())
    return total.hexdigest()


if __name__ == "__main__":
    from surecut.estimator.threads import use_one_thread

    use_one_thread()
    from surecut.estimator.optimise import rig_of
    from surecut.estimator.sensed_log import may_fork, opened
    from surecut.io.reader import LogReader

    log = Path(sys.argv[1])
    with LogReader(log) as reader:
        rig = rig_of(reader, None)
    copies = may_fork()
    with opened(log, rig, 2) as recording:
        print(copies, digest(recording))
