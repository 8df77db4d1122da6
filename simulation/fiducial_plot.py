"""The paper's figures 5 and 6 again: measured depth less true depth against the distance."""

from io import BytesIO

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure

from ..factors.errors import SurecutError
from .fiducial_experiment import METHODS, Outcome

FORMATS = {".svg": FigureCanvasSVG, ".png": FigureCanvasAgg}
_COLOURS = {"raw": "#b04030", "times S": "#c09030", "joint": "#107040"}
_MARKS = {"raw": "x", "times S": "+", "joint": "o"}


def draw(outcome: Outcome, suffix: str) -> bytes:
    """A picture with one panel per side length.

    Args:
        suffix: `.svg` or `.png`.

    Raises:
        SurecutError: another format.
    """
    if suffix.lower() not in FORMATS:
        raise SurecutError(f"plot: {suffix or 'no suffix'} is not known; name the file .svg or .png")
    sides = outcome.setup.typed_sides_m
    figure = Figure(figsize=(5.2 * len(sides), 4.0), layout="constrained")
    for axes, typed in zip(np.ravel(figure.subplots(1, len(sides))), sides, strict=True):
        _panel(axes, outcome, typed)
    stream = BytesIO()
    with rc_context({"svg.hashsalt": "surecut"}):
        FORMATS[suffix.lower()](figure).print_figure(
            stream, format=suffix[1:].lower(), dpi=130, metadata=_plain(suffix)
        )
    return stream.getvalue()


def _plain(suffix: str) -> dict[str, None] | None:
    """No date: the same data give the same file."""
    return {"Date": None} if suffix.lower() == ".svg" else None


def _panel(axes: Axes, outcome: Outcome, typed: float) -> None:
    setup = outcome.setup
    for offset, method in zip((-8, 0, 8), METHODS, strict=True):
        mine = [d for d in outcome.depths if d.method == method and d.typed_side_m == typed]
        x = np.array([1e3 * d.distance_m + offset for d in mine])
        y = np.array([1e3 * (d.depth_m - d.true_m) for d in mine])
        axes.plot(x, y, _MARKS[method], ms=4, mfc="none", color=_COLOURS[method], label=method)
    joint = {d.distance_m: d.sigma_m for d in outcome.depths if d.method == "joint" and d.typed_side_m == typed}
    at = np.array(sorted(joint))
    half = np.array([1.96e3 * (joint[z] or 0.0) for z in at])
    axes.fill_between(1e3 * at, -half, half, color=_COLOURS["joint"], alpha=0.12, lw=0, label="joint, stated 95 %")
    axes.axhline(0, color="black", lw=0.6)
    if abs(typed - setup.side_m) > 1e-6:
        axes.set_yscale("symlog", linthresh=10)
    axes.set_title(f"{1e3 * setup.side_m:.0f} mm markers, side given as {1e3 * typed:.0f} mm", fontsize=10)
    axes.set_xlabel("distance [mm]")
    axes.set_ylabel("measured less true depth [mm]")
    axes.legend(fontsize=8)
