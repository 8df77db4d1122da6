"""Results built by hand for the tests of the report: every number is chosen here."""

import dataclasses

import numpy as np

from surecut.estimator.result import (
    CalibrationEstimate,
    Consistency,
    DistanceEstimate,
    FamilyConsistency,
    PipeEstimate,
    PointEstimate,
    PoseEstimate,
    Result,
)
from surecut.factors.measurements import Event, Rejection
from surecut.factors.rig import Board, Box, Cut, Distance, Marker, Mount, Pose, Rig, dump_rig

START_NS = 1_790_000_000_000_000_000
SECOND = 1_000_000_000
AXIS = np.array([0.06, 0.995, 0.08]) / np.linalg.norm([0.06, 0.995, 0.08])
SOURCES = {
    # Standard deviations in mm along x, y, z of {b}, and the turn of the ellipsoid about y in degrees.
    "marker corners": (1.1, 0.9, 1.6, 10.0),
    "board geometry": (0.5, 0.4, 0.9, 10.0),
    "mount": (0.9, 0.9, 0.9, 0.0),
    "odometry": (1.3, 0.8, 2.1, -25.0),
    "stereo calibration": (0.4, 0.2, 1.9, 5.0),
    "depth cloud": (0.2, 0.2, 0.6, 0.0),
    "picks": (0.7, 1.2, 0.8, 20.0),
}


def turned(sigmas_mm, degrees):
    """Covariance in m² with the given sigmas, turned about y."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    turn = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
    return turn @ np.diag(np.square(np.asarray(sigmas_mm) * 1e-3)) @ turn.T


def make_budget(scale=1.0):
    return {name: scale**2 * turned(row[:3], row[3]) for name, row in SOURCES.items()}


def make_point(point_id="P1", role="cut", scale=1.0, position=(0.352, -0.118, 1.846), axis=AXIS):
    budget = make_budget(scale)
    covariance = sum(budget.values())
    return PointEstimate(
        id=point_id,
        role=role,
        frame="b",
        position_m=np.array(position),
        covariance_m2=covariance,
        radius95_m=float(2.6 * np.sqrt(np.linalg.eigvalsh(covariance)[-1])),
        measurements=8,
        axis=axis,
        pipe_id=None if axis is None else "pipe0",
        budget=budget,
    )


def make_pose(name, parent, translation, stamp_ns, angle=0.3):
    matrix = np.eye(4)
    c, s = np.cos(angle), np.sin(angle)
    matrix[:3, :3] = [[c, -s, 0], [s, c, 0], [0, 0, 1]]
    matrix[:3, 3] = translation
    return PoseEstimate(name, parent, stamp_ns, matrix, np.diag([4e-6, 4e-6, 9e-6, 1e-6, 1e-6, 1e-6]))


def make_rig(cuts=None):
    board = Board(
        id="f0",
        markers=tuple(Marker(id=29 + i, centre_m=(0.12 * (i % 3 - 1), 0.12 * (i // 3 - 0.5))) for i in range(6)),
    )
    if cuts is None:
        box = Box(minimum_m=(0.45, -0.6, 1.7), maximum_m=(0.6, 0.6, 2.2))
        cuts = (
            Cut(
                point="P1",
                tolerance_along_m=0.010,
                tolerance_across_m=0.012,
                blade_width_m=0.004,
                clearance_m=0.02,
                keep_out=(box,),
            ),
        )
    mount = Mount(board="f0", f_T_b=Pose(translation_m=(0.1, -0.3, 0.2)))
    distance = Distance.model_validate({"from": "29", "to": "31", "distance_m": 0.24, "sigma_m": 0.0005})
    return Rig(boards=(board,), mount=mount, distances=(distance,), cut_plan=tuple(cuts))


TENTHS = (410, 420, 431, 402, 399, 417, 425, 408, 416, 432)


def make_consistency(passed=True):
    families = (
        FamilyConsistency("marker corners", 4012.3, 3968.0, 0.92, 1.08, 4160, 31, TENTHS),
        FamilyConsistency("inter-marker distances", 1.4, 1.0, 0.001, 6.6, 1, 0),
        FamilyConsistency("stereo odometry", 88412.0, 89120.0, 0.95, 1.05, 91233, 1820),
        FamilyConsistency("depth cloud", 712.0, 700.0, 0.85, 1.15, 720, 12, (60, 66, 71, 70, 69, 68, 75, 73, 78, 90)),
        FamilyConsistency("picks", 9.1, 11.0, 0.35, 2.0, 16, 0),
    )
    paths = {"board path against cloud path": 0.8, "stereo depth against Kinect depth": 1.6, "without odometry": 0.4}
    reasons = () if passed else ("stereo odometry: chi-square per degree of freedom 3.20 above the limit of 1.05",)
    if not passed:
        families = (*families[:2], dataclasses.replace(families[2], chi2=3.2 * 89120.0), *families[3:])
    return Consistency(93146.8, 93800.0, families, paths, passed, reasons)


def make_rejections():
    def at(seconds):
        return START_NS + int(seconds * SECOND)

    gate = "squared Mahalanobis distance above the gate"
    return (
        *(Rejection(at(3 + i * 0.05), "marker corners", f"marker 31 in m_left #{i}", gate, 40.0 + i, 23.5)
          for i in range(7)),
        Rejection(at(12.2), "picks", "P1 in m_right", "off the epipolar line, pixels", 11.2, 3.0),
        Rejection(at(20.0), "depth cloud", "frame 600", "planar fit rms in m", 0.031, 0.012),
    )  # fmt: skip


def make_result(points=None, rig=None, consistency=None, last_board_age_s=4.0, **changes):
    """A result of a 30 s recording that an engineer would trust."""
    end = START_NS + 30 * SECOND
    points = (make_point(), make_point("G1", "grasp", 1.1, (0.36, 0.07, 1.861))) if points is None else points
    pipe = PipeEstimate("pipe0", "b", np.array([0.352, -0.118, 1.846]), AXIS, 0.0446, np.diag([4e-6] * 7))
    result = Result(
        points=tuple(points),
        poses=(
            make_pose("b", "o", (0.2, 0.1, -0.4), end),
            make_pose("f0", "o", (0.1, 0.4, -0.2), end, 0.1),
            make_pose("m", "o", (1.0, 0.2, 0.3), end, 1.2),
        ),
        trajectory=tuple(
            make_pose("m", "o", (np.sin(0.1 * i), 0.0, 0.05 * i), START_NS + i * SECOND, 0.01 * i) for i in range(31)
        ),
        pipes=(pipe,),
        calibration=(
            CalibrationEstimate("stereo baseline", "m", 0.0998, 0.0003, 0.1002, 0.0020, False),
            CalibrationEstimate("Kinect depth offset", "m", 0.0121, 0.0021, 0.0, 0.02, False),
            CalibrationEstimate("Kinect depth scale", "1", 0.0012, 0.0017, 0.0, 0.01, False),
            CalibrationEstimate("b_rgb focal length", "px", 525.0, 0.0, 525.0, 1.6, True),
        ),
        distances=(
            DistanceEstimate("29 to 31", 0.2402, 0.0002, 0.24, 0.0005),
            DistanceEstimate("32 to 34", 0.2399, 0.0003),
        ),
        consistency=make_consistency() if consistency is None else consistency,
        rejected=make_rejections(),
        events=(Event(START_NS + 5 * SECOND, "marker_dim", "Marker 31 is half in shadow for 1.2 s.", "info"),),
        streaming_difference_sigma={"P1": 0.21, "b": 0.14},
        timing={"total_s": 3.1},
        provenance={
            "surecut": "0.1.0",
            "log_sha256": "a" * 64,
            "rig_sha256": "b" * 64,
            "command": "surecut optimise cell.mcap -o result.mcap",
            "gtsam": "4.3.0",
        },
        config_yaml=dump_rig(make_rig() if rig is None else rig),
        last_board_view_ns=None if last_board_age_s is None else end - int(last_board_age_s * SECOND),
        end_ns=end,
    )
    return dataclasses.replace(result, **changes)
