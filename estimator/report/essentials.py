"""The first pages: may we cut, where, what the doubt is made of, what to do next."""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from ..decision import Decision, percent
from ..result import PickView, PointEstimate, Result
from .axes import K3, Triad, half_axes, triad
from .blocks import Banner, Block, Drawing, Gallery, Heading, Paragraph, Table
from .drawings import budget_bars, three_views, verdict_sign
from .pick_figure import pick_figure
from .text import decimals, duration, fixed, mm, mm_with, utc

Float = NDArray[np.float64]

NO_VERDICT = "NO VERDICT"
K1 = 1.96
"""Coverage factor of a single number for 95 %."""
ADVICE_SHOWN = 4
BARS_SHOWN = 6
VIEWS_SHOWN = 4


def point_pages(result: Result, point: PointEstimate, decision: Decision | None, first: bool) -> Iterator[Block]:
    """One page about a point: verdict, place, views, what limits it, what to do next."""
    yield Heading(heading(point), 1, new_page=not first)
    yield banner(point.id, decision, result)
    if not drawable(point):
        yield Paragraph("No region can be drawn: the covariance is not finite or singular.")
        return
    yield Heading("Where")
    yield _position(point)
    yield Drawing(three_views(point, decision.cut if decision else None), _views_caption(decision))
    yield Heading("What limits it")
    yield from _budget_chart(point)
    yield Heading("What to do next")
    yield from _advice(result, point)


def detail_pages(result: Result, point: PointEstimate, first: bool) -> Iterator[Block]:
    """The numbers behind the page: ellipsoid, budget as a table, images."""
    if not drawable(point):
        return
    directions = triad(point)
    yield Heading(f"{heading(point)}: the numbers behind it", 1, new_page=first)
    yield _ellipsoid(point, directions)
    yield from _next_to_it(point)
    yield from _budget_table(point, directions)
    yield from _images(result, point)


def heading(point: PointEstimate) -> str:
    """`Point P1 (cut)`."""
    return f"Point {point.id} ({point.role})" if point.role else f"Point {point.id}"


def banner(point_id: str, decision: Decision | None, result: Result) -> Banner:
    """The verdict in words with the number that decided."""
    if decision is None:
        return Banner(
            point=point_id,
            verdict=None,
            word=NO_VERDICT,
            headline=f"The cut plan has no entry for {point_id}: without tolerances there is no permission to cut.",
            figures=(),
            details=(),
            sign=verdict_sign(None),
        )
    return Banner(
        point=point_id,
        verdict=decision.verdict,
        word=decision.verdict,
        headline=decision.headline,
        figures=tuple(_figures(decision)),
        details=tuple(_details(decision, result)),
        sign=verdict_sign(decision.verdict),
    )


def _figures(decision: Decision) -> Iterator[tuple[str, str]]:
    chance = "cannot be stated" if decision.probability is None else percent(decision.probability)
    yield (
        ("all limits kept, were it not for the doubts" if decision.blockers else "all limits kept, tool included"),
        chance,
    )
    yield "required", percent(decision.required)
    yield "with a perfect measurement", percent(decision.tool_only)
    if decision.blockers or decision.margin is None:
        return
    if decision.margin >= 1:
        yield "reserve of uncertainty", f"factor {np.floor(decision.margin * 100) / 100:.2f}"
    else:
        yield "uncertainty must fall to", _percent_of(decision.margin)


def _details(decision: Decision, result: Result) -> Iterator[str]:
    # The first blocker stands in the headline already.
    for blocker in decision.blockers[1:] if decision.verdict == "MEASURE MORE" else decision.blockers:
        yield f"Also: {blocker}."
    for requirement in decision.requirements:
        yield f"{requirement.text[:1].upper()}{requirement.text[1:]}: kept with {percent(requirement.probability)}."
    if decision.expires_ns is not None and result.last_board_view_ns is not None:
        age = duration((result.end_ns - result.last_board_view_ns) * 1e-9)
        ends = "ends" if decision.expires_ns >= result.end_ns else "ended"
        yield f"Board last seen {age} before the end of the recording; permission {ends} at {utc(decision.expires_ns)}."
    yield from decision.notes


def _percent_of(factor: float) -> str:
    return f"{np.floor(factor * 1000) / 10:.3g} %"


def drawable(point: PointEstimate) -> bool:
    """Whether there is a finite region at all."""
    if not (np.isfinite(point.covariance_m2).all() and np.isfinite(point.position_m).all()):
        return False
    return bool(np.linalg.eigvalsh(point.covariance_m2)[-1] > 0)


def _position(point: PointEstimate) -> Table:
    expanded = K3 * np.sqrt(np.maximum(np.diag(point.covariance_m2), 0))
    cells = tuple(mm_with(value, u) for value, u in zip(point.position_m, expanded, strict=True))
    row = (*cells, mm(point.radius95_m), str(point.measurements))
    return Table(
        caption=(
            f"Position in {{{point.frame}}}, the machine's depth camera. Expanded uncertainty with k = {K3:.2f}: "
            f"95 % in three dimensions."
        ),
        header=("x (right)", "y (down)", "z (forward)", "95 % within a sphere of", "measurements"),
        rows=(row,),
        numeric=(0, 1, 2, 3, 4),
    )


def _views_caption(decision: Decision | None) -> str:
    text = "The three views have one scale. The cross is the estimate, where the tool would be sent."
    return text if decision else text + " No tolerance is drawn: the cut plan names none."


def _ellipsoid(point: PointEstimate, directions: Triad) -> Table:
    shadow = K3 * np.sqrt(np.maximum(np.diag(directions.turned(point.covariance_m2)), 0))
    rows = [("reach in the direction itself", "", *(mm(reach) for reach in shadow))]
    for index, axis in enumerate(half_axes(point, directions)):
        angles = (f"{angle:.0f}°" for angle in axis.angles_deg)
        rows.append((f"half axis {index + 1}, angle to each direction", mm(axis.length_m), *angles))
    return Table(
        caption="The 95 % ellipsoid of the measurement, seen from the pipe.",
        header=("", "length", *directions.names),
        rows=tuple(rows),
        numeric=(1, 2, 3, 4),
        widths=(0.4, 0.15, 0.15, 0.15, 0.15),
    )


def _next_to_it(point: PointEstimate) -> Iterator[Block]:
    surface = point.nearest_surface
    if surface is not None:
        apart = mm_with(surface.distance_m, K1 * surface.sigma_m)
        yield Paragraph(
            f"The nearest mapped surface that is not the pipe itself: {apart} from the point ({surface.what}; expanded "
            f"uncertainty with k = {K1:.2f})."
        )


def budget_rows(point: PointEstimate) -> list[tuple[str, Float]]:
    """Sources and contributions, shape (3, 3) each, largest trace first."""
    return sorted(point.budget.items(), key=lambda item: (-float(np.trace(item[1])), item[0]))


def family_shares(point: PointEstimate) -> dict[str, float]:
    """Variance [m²], summed over the three directions, by family: what stands before the colon of a source's name."""
    shares: dict[str, float] = {}
    for name, part in budget_rows(point):
        family = name.partition(":")[0]
        shares[family] = shares.get(family, 0.0) + float(np.trace(part))
    return shares


def budget_closure(point: PointEstimate) -> float:
    """Largest deviation of the budget's sum from the covariance, relative to the covariance's largest entry."""
    total = np.sum([part for _, part in budget_rows(point)], axis=0) if point.budget else np.zeros((3, 3))
    return float(np.abs(total - point.covariance_m2).max() / np.abs(point.covariance_m2).max())


def _budget_chart(point: PointEstimate) -> Iterator[Block]:
    if not point.budget:
        yield Paragraph("The result holds no uncertainty budget for this point.")
        return
    total = float(np.trace(point.covariance_m2))
    families = sorted(family_shares(point).items(), key=lambda item: (-item[1], item[0]))
    shares = [(name, trace / total) for name, trace in families[:BARS_SHOWN]]
    if len(families) > BARS_SHOWN:
        rest = sum(trace for _, trace in families[BARS_SHOWN:]) / total
        shares.append((f"{len(families) - BARS_SHOWN} more", rest))
    bars = budget_bars(shares, f"Uncertainty budget of {point.id}")
    yield Drawing(bars, "Share of each source in the total variance of the measured point.")
    closure = budget_closure(point)
    if closure > 1e-9:
        yield Paragraph(f"The budget does not add up: it misses the covariance by {closure:.1g} of its size.")


def _budget_table(point: PointEstimate, directions: Triad) -> Iterator[Block]:
    if not point.budget:
        return
    total = float(np.trace(point.covariance_m2))
    places = decimals(float(np.sqrt(total)) * 1e3) + 1
    table = [
        (name, *(_root(v, places) for v in np.diag(directions.turned(part))), _share(float(np.trace(part)) / total))
        for name, part in budget_rows(point)
    ]
    sums = np.diag(directions.turned(point.covariance_m2))
    table.append(("combined standard uncertainty", *(_root(v, places) for v in sums), "100.0 %"))
    expanded = (fixed(K3 * float(np.sqrt(max(v, 0.0))) * 1e3, places) for v in sums)
    table.append((f"expanded, k = {K3:.2f}", *expanded, ""))
    yield Table(
        caption="Uncertainty budget: standard uncertainty in mm by direction. The squares add up.",
        header=("source", *directions.names, "share of variance"),
        rows=tuple(table),
        numeric=(1, 2, 3, 4),
        total=2,
        widths=(0.4, 0.14, 0.14, 0.14, 0.18),
    )


def _share(share: float) -> str:
    return f"{share * 100:.1f} %" if abs(share) >= 5e-4 or share == 0 else "below 0.1 %"


def _root(variance: float, places: int) -> str:
    """Standard uncertainty in mm; a contribution that takes variance away is marked."""
    root = fixed(float(np.sqrt(abs(variance))) * 1e3, places)
    return root if variance >= 0 else f"less {root}"


def _advice(result: Result, point: PointEstimate) -> Iterator[Block]:
    advice = result.advice.get(point.id, ())
    if not advice:
        yield Paragraph("The result names no further measurement for this point.")
        return
    rows = tuple(
        (a.action, a.detail, f"{mm(point.radius95_m)} to {mm(a.predicted_radius95_m)}", f"{max(a.gain, 0) * 100:.0f} %")
        for a in advice[:ADVICE_SHOWN]
    )
    yield Table(
        caption="Predicted radius of the 95 % region after each, best first.",
        header=("Do this", "How", "95 % within", "gain"),
        rows=rows,
        numeric=(2, 3),
        widths=(0.3, 0.42, 0.19, 0.09),
    )


def _images(result: Result, point: PointEstimate) -> Iterator[Block]:
    views = [view for view in result.pick_views if view.point_id == point.id]
    if not views:
        return
    shown = tuple(Drawing(pick_figure(view), _view_caption(view)) for view in views[:VIEWS_SHOWN])
    yield Gallery(shown)
    if len(views) > VIEWS_SHOWN:
        yield Paragraph(f"{len(views) - VIEWS_SHOWN} more views are left out.", note=True)


def _view_caption(view: PickView) -> str:
    return f"{view.camera}, {utc(view.stamp_ns)}. Cross: the estimate; curve: its 95 % region in this image."
