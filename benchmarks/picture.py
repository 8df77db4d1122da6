"""The README's picture, from a recording and its result: what the camera saw, and the cell from above.

python benchmarks/picture.py logs/demo.mcap logs/demo.json docs/picture.png
"""

import sys
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.patches import Ellipse

from surecut.estimator.result import Result
from surecut.estimator.result_json import from_json
from surecut.io.messages import ImageBody, PickBody
from surecut.io.reader import LogReader


def main(log: Path, result_file: Path, out: Path) -> None:
    result = from_json(result_file.read_text())
    figure, (seen, plan) = plt.subplots(1, 2, figsize=(11, 4.2), width_ratios=(1.25, 1))
    draw_pick(seen, log)
    draw_plan(plan, result)
    figure.tight_layout()
    figure.savefig(out, dpi=90)


def draw_pick(axes: plt.Axes, log: Path) -> None:
    """The newest pick in the left image."""
    picks = [m for m in LogReader(log, {"/picks"}) if isinstance(m.body, PickBody) and m.body.camera == "m_left"]
    stamp = picks[-1].stamp_ns
    for message in LogReader(log, {"/m/left/image_raw", "/m/left/image_raw/compressed"}):
        if message.stamp_ns == stamp and isinstance(message.body, ImageBody):
            axes.imshow(message.body.pixels(), cmap="gray", vmin=0, vmax=255)
    for pick in picks:
        if pick.stamp_ns == stamp and isinstance(pick.body, PickBody):
            axes.plot(*pick.body.px, "+", color="tab:orange", ms=14, mew=2)
            axes.annotate(pick.body.point_id, pick.body.px, (10, 8), textcoords="offset points", color="tab:orange")
    axes.set_title("mobile camera {m}: the operator's picks", fontsize=10)
    axes.axis("off")


def draw_plan(axes: plt.Axes, result: Result) -> None:
    """The x-z plane of {b}, seen from above, ellipses ten times enlarged."""
    poses = {p.name: p.matrix for p in result.poses}
    b_T_o = np.linalg.inv(poses["b"])
    path = np.array([(b_T_o @ p.matrix)[:3, 3] for p in result.trajectory])
    axes.plot(path[:, 0], path[:, 2], color="tab:blue", lw=1, label="{m}, the camera's way")
    axes.plot(0, 0, "s", color="black", label="{b}, the Kinect")
    for name in (n for n in poses if n not in ("b", "m")):
        place = (b_T_o @ poses[name])[:3, 3]
        axes.plot(place[0], place[2], "D", color="tab:green", label=f"{{f}}, board {name}")
    for p in result.points:
        variances, vectors = np.linalg.eigh(p.covariance_m2[np.ix_([0, 2], [0, 2])])
        angle = np.degrees(np.arctan2(vectors[1, 1], vectors[0, 1]))
        size = 10 * 2 * 2.448 * np.sqrt(variances)
        axes.add_patch(Ellipse(p.position_m[[0, 2]], size[1], size[0], angle=angle, fill=False, color="tab:orange"))
        axes.plot(*p.position_m[[0, 2]], "+", color="tab:orange")
    radius = max(1e3 * p.radius95_m for p in result.points)
    axes.set_title(f"from above, in {{b}}; 95 % ellipses x 10 (radius {radius:.0f} mm)", fontsize=10)
    axes.set_xlabel("x, m")
    axes.set_ylabel("z, m")
    axes.set_aspect("equal")
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8, loc="upper left", bbox_to_anchor=(1.02, 1.0))


if __name__ == "__main__":
    main(*(Path(a) for a in sys.argv[1:4]))
