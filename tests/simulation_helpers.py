"""Small sessions for the tests of the simulation, and an edge-based corner finder that owes nothing to OpenCV's."""

import cv2
import numpy as np

from surecut.simulation.scenario import Scenario
from surecut.simulation.sensor import directions, project


def small(**changes) -> Scenario:
    """A scenario that starts and renders fast."""
    data = {
        "name": "test",
        "duration_s": 2.0,
        "detail": 0.2,
        "mobile": {"width": 120, "height": 80, "focal_px": 90.0, "rate_hz": 10.0},
        "kinect": {"width": 160, "height": 120, "rate_hz": 2.0},
    }
    return Scenario.model_validate({**data, **changes})


def edge_corners(image, guess, lens):
    """Corners of a dark quadrilateral in a noise-free linear image, shape (4, 2).

    Every side is sampled across at many places; the half-way crossings, their distortion undone, are fitted by a line;
    lines are cut. The windows stay inside the marker's black border.
    """
    lines = []
    for k in range(4):
        a, b = guess[k], guess[(k + 1) % 4]
        along = (b - a) / np.linalg.norm(b - a)
        normal = np.array([-along[1], along[0]])
        points = []
        for share in np.linspace(0.15, 0.85, 41):
            reach = 0.13 * np.linalg.norm(b - a)
            steps = np.linspace(-reach, reach, 81)
            line = a + share * (b - a) + steps[:, None] * normal
            x, y = line[:, 0].astype(np.float32)[None], line[:, 1].astype(np.float32)[None]
            profile = cv2.remap(image, x, y, cv2.INTER_LINEAR)[0]
            level = (profile[:8].mean() + profile[-8:].mean()) / 2
            sign = np.sign(profile - level)
            change = np.flatnonzero(sign[:-1] * sign[1:] < 0)
            assert len(change) == 1
            i = change[0]
            t = (level - profile[i]) / (profile[i + 1] - profile[i])
            points.append(a + share * (b - a) + (steps[i] + t * (steps[1] - steps[0])) * normal)
        points = directions(lens, np.array(points))[:, :2]
        centre = points.mean(axis=0)
        lines.append((centre, np.linalg.svd(points - centre)[2][1]))
    corners = []
    for k in range(4):
        (p, n), (q, m) = lines[k - 1], lines[k]
        corners.append(np.linalg.solve(np.stack([n, m]), np.array([n @ p, m @ q])))
    return project(lens, np.concatenate([corners, np.ones((4, 1))], axis=1))
