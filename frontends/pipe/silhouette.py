"""The outline of a pipe in one image: two occluding edges near a pick, or near where the pipe is expected."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from ...factors.camera import CameraModel
from ...factors.measurements import CameraName, OutlineSighting, Rejection
from ..rays import ideal_grid
from ..undistort import distort, undistort
from .edges import EdgeLine, image_noise, straight_lines
from .hypotheses import Begun, Found, confirmed, outermost, refined, same_place, seen_sides
from .limb import EdgeFit, Window
from .pairs import EdgePair, OutlinePrior, PairLimits, edge_pairs
from .surface import MOST_BY_REGION, region_edges, region_scores, sampled

Float = NDArray[np.float64]
Grey = NDArray[np.uint8]


@dataclass(frozen=True, slots=True)
class OutlineConfig:
    """What counts as an outline."""

    reach_px: float = 80.0
    """Edges are followed so far from the centre."""
    click_sigma_px: float = 1.5
    limits: PairLimits = field(default_factory=PairLimits)
    refined_pairs: int = 7
    """Hypotheses that get the sub-pixel fit."""
    refined_known: int = 3
    """The same where width and place are known beforehand."""
    lowest_quality: float = 0.8
    largest_sigma_px: float = 0.5
    """An edge whose place is less sure than this is no measurement."""
    shortest_px: float = 14.0
    largest_surprise: float = 9.2
    """Chi-square (2 degrees of freedom, 99 %) of middle and width against the prior."""
    textured: float = 5.0
    """Log-likelihood ratio of `surface.region_score` from which the background's texture shows where the pipe ends."""
    lowest_sharpness: float = 0.55
    """See `limb.EdgeFit.sharpness`."""


_REGIONS = 30
"""Hypotheses whose inside is looked at."""
_REGIONS_AT_ONCE = 8


@dataclass(frozen=True, slots=True)
class OutlineView:
    """A picture in which an outline is to be looked for."""

    finder: "OutlineFinder"
    stamp_ns: int
    pipe_id: str
    image: Grey
    prior: OutlinePrior


class OutlineFinder:
    """Finds pipe outlines in images of one camera. Holds the lens table only."""

    def __init__(self, camera: CameraModel, config: OutlineConfig | None = None) -> None:
        self._camera = camera
        self._config = config or OutlineConfig()
        self._ideal = ideal_grid(camera)

    def near_pick(
        self, stamp_ns: int, pipe_id: str, image: Grey, pick_px: Float,
        expected_radius_px: tuple[float, float] | None = None,
        axis_hint_px: Float | None = None,
    ) -> OutlineSighting | Rejection:  # fmt: skip
        """The outline about an operator's pick.

        Args:
            stamp_ns: Time of the image.
            pipe_id: Which pipe.
            image: Shape (height, width), grey, as recorded (distorted).
            pick_px: Shape (2,), ideal pixels, on the middle of the visible outline to the click's sigma.
            expected_radius_px: Half the outline's width and its sigma, px, where the diameter is known.
            axis_hint_px: Shape (2,), direction of the pipe in the image, good to 10 degrees.
        """
        width, width_sigma = expected_radius_px or (None, 0.0)
        direction = None if axis_hint_px is None else float(np.arctan2(axis_hint_px[1], axis_hint_px[0]))
        prior = OutlinePrior(pick_px, self._config.click_sigma_px, width, width_sigma, direction, np.deg2rad(10.0))
        return self.find(stamp_ns, pipe_id, image, prior)

    def find(self, stamp_ns: int, pipe_id: str, image: Grey, prior: OutlinePrior) -> OutlineSighting | Rejection:
        """The outline that a prior describes, or why there is none."""
        return find_outlines([OutlineView(self, stamp_ns, pipe_id, image, prior)])[0]

    def begin(self, view: OutlineView) -> Begun | Rejection:
        """The hypotheses of one picture, or why there are none."""
        config, prior, image = self._config, view.prior, view.image
        rows, columns = self._window(prior.centre_px)
        if rows.stop - rows.start < 12 or columns.stop - columns.start < 12:
            return self._refuse(view, "place of the pipe is outside the image, px from its border", 0.0, 6.0)
        grey = image[rows, columns].astype(np.float32)
        noise = image_noise(grey)
        patch, centre = self._ideal_patch(image, prior.centre_px)
        origin = prior.centre_px - centre
        lines = straight_lines(patch, centre, noise, self._widest(prior), self._angles(prior))
        lines += self._textured(patch, centre, lines, prior)
        pairs = edge_pairs(lines, prior, self._camera.fx, config.limits, _REGIONS)
        pairs = self._filled(pairs, patch, origin, prior)
        if not pairs:
            return self._refuse(view, "pairs of straight edges about the pick", 0.0, 1.0)
        window = Window(grey.astype(float).ravel(), self._ideal[rows, columns].reshape(-1, 2), noise)
        return Begun(prior, pairs, window, patch, origin)

    def _window(self, centre: Float) -> tuple[slice, slice]:
        reach = self._config.reach_px
        near = np.abs(self._ideal[..., 0] - centre[0]) < reach
        near &= np.abs(self._ideal[..., 1] - centre[1]) < reach
        rows, columns = np.nonzero(near.any(axis=1))[0], np.nonzero(near.any(axis=0))[0]
        if len(rows) == 0:
            return slice(0, 0), slice(0, 0)
        return slice(int(rows[0]), int(rows[-1]) + 1), slice(int(columns[0]), int(columns[-1]) + 1)

    def _ideal_patch(self, image: Grey, centre: Float) -> tuple[NDArray[np.float32], Float]:
        """The surroundings of a place in ideal pixels, NaN outside the image, and the place in the patch."""
        half = int(np.ceil(1.5 * self._config.reach_px))
        corner = np.floor(centre) - half
        grid = np.stack(np.meshgrid(*(np.arange(2 * half + 2, dtype=float),) * 2), axis=2) + corner
        raw = distort(self._camera, grid)
        patch = sampled(image.astype(np.float32), raw)
        return patch, centre - corner

    def _widest(self, prior: OutlinePrior) -> float:
        limit = 0.5 * self._config.limits.widest_px
        if prior.half_width_px is not None:
            limit = min(limit, prior.half_width_px + 4 * prior.half_width_sigma_px)
        return limit + 3 * prior.middle_sigma_px

    @staticmethod
    def _angles(prior: OutlinePrior) -> tuple[float, float] | None:
        if prior.direction_rad is None:
            return None
        return prior.direction_rad + np.pi / 2, 3 * prior.direction_sigma_rad + np.deg2rad(6.0)

    def _textured(
        self, patch: NDArray[np.float32], centre: Float, lines: list[EdgeLine], prior: OutlinePrior
    ) -> list[EdgeLine]:
        """Edges without much contrast on the whole, but with texture on one side only."""
        if prior.direction_rad is None:
            angles = [line.angle for line in sorted(lines, key=lambda line: -line.evidence)[:6]]
        else:
            spread = np.clip(prior.direction_sigma_rad, 0.0, 0.05)
            angles = [prior.direction_rad + np.pi / 2 + step * spread for step in (-1.0, 0.0, 1.0)]
        found = []
        for angle in angles:
            for rho, evidence in region_edges(patch, centre, angle, self._widest(prior)):
                turned = float(np.mod(angle, np.pi))
                sign = 1.0 if np.cos(angle - turned) > 0 else -1.0
                found.append(EdgeLine(turned, sign * rho, (-40.0, 40.0), min(evidence, 12.0)))
        return found

    def _filled(
        self, pairs: list[EdgePair], patch: NDArray[np.float32], origin: Float, prior: OutlinePrior
    ) -> list[EdgePair]:
        """The hypotheses that are best with what the region between their edges says, best first."""
        most = self._config.refined_pairs if prior.half_width_px is None else self._config.refined_known
        best: list[EdgePair] = []
        for i in range(0, len(pairs), _REGIONS_AT_ONCE):
            if len(best) == most and pairs[i].score + MOST_BY_REGION < best[-1].score:
                break  # no other can reach these
            some = pairs[i : i + _REGIONS_AT_ONCE]
            half_width = 0.5 * np.array([pair.width_px for pair in some])
            region = region_scores(patch, origin, np.array([pair.lines for pair in some]), prior.centre_px, half_width)
            best += [replace(p, score=p.score + r, region=r) for p, r in zip(some, region.tolist(), strict=True)]
            best = sorted(best, key=lambda pair: -pair.score)[:most]
        return best

    def decide(self, view: OutlineView, found: list[Found]) -> OutlineSighting | Rejection:
        """The best hypothesis, best first, if it stands out and is good enough."""
        prior = view.prior
        if not found:
            return self._refuse(view, "pairs of edges with a sub-pixel fit", 0.0, 1.0)
        config = self._config
        scores = np.array([f.score for f in found])
        share = np.exp(scores - scores.max())
        same = np.array([same_place(f, found[0], prior.centre_px) for f in found])
        quality = float(share[same].sum() / share.sum())
        if quality < self._config.lowest_quality:
            return self._refuse(view, "outline is ambiguous, probability of the best pair of edges",
                                quality, self._config.lowest_quality)  # fmt: skip
        best = found[0]
        if best.fits is None:
            return self._refuse(view, "pairs of edges with a sub-pixel fit", 0.0, 1.0)
        if best.pair.surprise > config.largest_surprise:
            return self._refuse(view, "edges lie where they are not expected, chi-square of 2",
                                best.pair.surprise, config.largest_surprise)  # fmt: skip
        trouble = [self._edge_trouble(fit, best.pair.region) for fit in best.fits]
        sure = [t is None for t in trouble]
        # With the width known one sure edge is a measurement; with nothing known both have to be found.
        if not any(sure) or (prior.half_width_px is None and not all(sure)):
            return self._refuse(view, *next(t for t in trouble if t is not None))
        return self._sighting(view, best, quality, sure)

    def _edge_trouble(self, fit: EdgeFit, region: float) -> tuple[str, float, float] | None:
        """Why an edge is no measurement: what, how much, limit."""
        config = self._config
        if fit.sharpness < config.lowest_sharpness and region < config.textured:
            return "edge is soft like shading, part of the change within 1 px", fit.sharpness, config.lowest_sharpness
        sigma = float(np.sqrt(fit.covariance[0, 0]))
        if sigma > config.largest_sigma_px:
            return "edge is unsure, sigma in px", sigma, config.largest_sigma_px
        length = fit.extent[1] - fit.extent[0]
        return ("edge is short, px", length, config.shortest_px) if length < config.shortest_px else None

    def _sighting(self, view: OutlineView, best: Found, quality: float, sure: list[bool]) -> OutlineSighting:
        assert best.fits is not None
        lines = np.array([fit.line for fit in best.fits])
        feet = np.array([fit.foot_px for fit in best.fits])
        along = np.column_stack((-lines[:, 1], lines[:, 0]))
        extent = np.array(
            [[foot + s * t for s in fit.extent] for foot, t, fit in zip(feet, along, best.fits, strict=True)]
        )
        # An edge that is not sure lies somewhere between the pipe's middle and as far outside.
        anywhere = np.diag([(0.5 * best.pair.width_px) ** 2, 0.1])
        known = zip(best.fits, sure, strict=True)
        covariance = np.array([fit.covariance if good else anywhere for fit, good in known])
        return OutlineSighting(
            view.stamp_ns, self._name, view.pipe_id, lines, covariance, feet, extent, view.prior.centre_px, quality
        )

    @property
    def _name(self) -> CameraName:
        return self._camera.name  # type: ignore[return-value]

    def _refuse(self, view: OutlineView, reason: str, value: float, limit: float) -> Rejection:
        return Rejection(view.stamp_ns, "outline", f"{self._camera.name} {view.pipe_id}", reason, value, limit)


def find_outlines(views: Sequence[OutlineView]) -> list[OutlineSighting | Rejection]:
    """The outline in each picture, or why there is none; the edges of all of them are fitted together."""
    begun = [view.finder.begin(view) for view in views]
    going = [one for one in begun if isinstance(one, Begun)]
    found = [
        outermost(sorted((seen_sides(hypothesis, one) for hypothesis in hypotheses), key=lambda f: -f.score))
        for one, hypotheses in zip(going, refined(going), strict=True)
    ]
    best = iter(confirmed(found, [one.window for one in going]))
    return [
        one if isinstance(one, Rejection) else view.finder.decide(view, next(best))
        for view, one in zip(views, begun, strict=True)
    ]


def silhouette_sighting(
    image: Grey,
    camera: CameraModel,
    pick_px: Float,
    expected_radius_px: tuple[float, float] | None = None,
    axis_hint_px: Float | None = None,
    *,
    raw: bool = False,
    stamp_ns: int = 0,
    pipe_id: str = "pipe0",
) -> OutlineSighting | Rejection:
    """The outline about one pick in one image; see `OutlineFinder.near_pick`. With `raw` the pick is a raw pixel."""
    pick = undistort(camera, pick_px)[0] if raw else pick_px
    return OutlineFinder(camera).near_pick(stamp_ns, pipe_id, image, pick, expected_radius_px, axis_hint_px)
