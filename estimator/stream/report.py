"""What is left to say at the end of a stream."""

import json
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from .stream import Stream


def summary_json(stream: "Stream") -> str:
    """The last answer and all counters."""
    answer = stream.answer()
    points = [] if answer is None else answer.points
    places = {} if answer is None else answer.places
    content = {
        "points": [
            {
                "id": p.id,
                "role": p.role,
                "frame": p.frame,
                "position_m": p.position_m.tolist(),
                "covariance_m2": p.covariance_m2.tolist(),
                "radius95_m": p.radius95_m,
                "measurements": p.measurements,
            }
            for p in points
        ],
        "poses": {name: {"frame": "o", "matrix": place.matrix.tolist()} for name, place in places.items()},
        "decisions": [] if answer is None else [{"point": d.cut.point, "verdict": d.verdict} for d in answer.decisions],
        "events": [] if answer is None else [e.text for e in answer.events],
        "counters": stream.counters(),
        "last_problem": stream.last_problem,
    }
    return json.dumps(content, indent=1, allow_nan=False) + "\n"


def summary_lines(stream: "Stream") -> list[str]:
    """For the screen."""
    answer, latency = stream.answer(), stream.latency
    lines = [
        f"{latency.number} frames, arrival to pose p50 {latency.percentile_ms(50):.1f} ms, "
        f"p99 {latency.percentile_ms(99):.1f} ms, worst {latency.worst_ns * 1e-6:.1f} ms"
    ]
    for point in answer.points if answer is not None else ():
        x, y, z = 1e3 * point.position_m
        lines.append(
            f"{point.id} ({point.role}) at ({x:.1f}, {y:.1f}, {z:.1f}) mm in b, "
            f"95 % within {1e3 * point.radius95_m:.1f} mm"
        )
    if stream.last_problem:
        lines.append(f"last problem: {stream.last_problem}")
    return lines
