"""Sub-pixel alignment of patches with their reference: inverse compositional, all patches at once.

Each patch is normalised to zero mean and unit variance, so that gain and bias of the brightness drop out; the warp's
linear part is given (it follows from the motion), the shift is estimated (Baker and Matthews, Lucas-Kanade 20 years
on, 2004, section 3.2; the projection against mean and template is the forward additive ECC step of Evangelidis and
Psarakis 2008 turned round).
"""

from dataclasses import dataclass, fields

import cv2
import numpy as np
from numpy.typing import NDArray

from .flow import inside
from .images import Picture

Float = NDArray[np.float64]
Float32 = NDArray[np.float32]
Bool = NDArray[np.bool_]


_CONVERGED_PX = 0.003
"""What is left after a step is a share of it, towards the guess, and alike in all patches: it has to be small. A patch
that still moves more than this after the last step is given up: those that creep are the bad ones."""
_LONGEST_STEP_PX = 1.5
_LARGEST_BEND = 0.4
_DONE = 0.4
"""Share of patches that have converged at which the rest goes on alone."""


@dataclass(slots=True)
class Patches:
    """Reference patches of n tracks with `m` samples each."""

    values: Float32
    """Shape (n, m), normalised."""
    gradient: Float32
    """Shape (n, 2, m), weighted: derivative of the values, over the contrast, by the shift, times the samples'
    weights."""
    along: Float
    """Shape (n, k): products of the derivatives with the values: a change of contrast, which is no motion."""
    inverse: Float
    """Shape (n, k, k), of the normal equations; k = 2 (shift) or 6 (shift and linear part)."""
    prior: Float
    """Shape (n, k, k): share of the step that pulls a bent warp back to the given one."""
    inverse_hessian: Float
    """Shape (n, 2, 2): covariance of the shift for unit variance of the raw difference, px^2 per grey value^2."""
    bend: Float
    """Shape (n, 2, 2): shift of the best fit, in the reference's pixels, by the curvature of the view (see
    `warp.curvatures`)."""
    contrast: Float
    """Shape (n,), standard deviation of the patch in grey values."""

    def __len__(self) -> int:
        return len(self.values)

    def take(self, index: NDArray[np.intp] | Bool) -> "Patches":
        """The patches at the given indices or of the given mask."""
        return Patches(*(getattr(self, name)[index] for name in _ARRAYS))

    def append(self, other: "Patches") -> "Patches":
        """These patches followed by others."""
        return Patches(*(np.concatenate((getattr(self, name), getattr(other, name))) for name in _ARRAYS))


_ARRAYS = tuple(field.name for field in fields(Patches))


@dataclass(frozen=True, slots=True)
class Alignment:
    """Where the patches are, and how well they fit."""

    px: Float
    """Shape (n, 2)."""
    correlation: Float
    """Shape (n,), normalised cross correlation at `px`; -1 where the patch left the image."""
    covariance: Float
    """Shape (n, 2, 2): of `px`, from the patch's structure and the residual, px^2, not yet calibrated."""
    converged: Bool
    """Shape (n,)."""
    bend: Float
    """Shape (n, 2, 2): linear part that fits beyond the given one, zero where only the shift is estimated."""

    def moved(self, offset: Float) -> "Alignment":
        """The same at places moved by `offset` (n, 2)."""
        return Alignment(self.px + offset, self.correlation, self.covariance, self.converged, self.bend)

    def take(self, index: NDArray[np.intp] | Bool) -> "Alignment":
        """Those at the given indices or of the given mask."""
        return Alignment(*(getattr(self, field.name)[index] for field in fields(Alignment)))


class PatchGrid:
    """Sample places and weights of a square patch.

    Args:
        radius: samples to each side of the middle.
        spacing_px: between samples.
        bend_sigma: standard deviation of the warp's linear part about the given one; 0 estimates the shift alone.
    """

    def __init__(self, radius: int, spacing_px: float = 1.0, bend_sigma: float = 0.0) -> None:
        self.affine = bend_sigma > 0
        axis = np.arange(-radius, radius + 1, dtype=np.float64) * spacing_px
        u, v = np.meshgrid(axis, axis)
        self.offsets = np.stack((u.ravel(), v.ravel()), axis=1)
        weights = np.exp(-0.5 * (self.offsets**2).sum(axis=1) / (0.6 * (radius + 0.5) * spacing_px) ** 2)
        self.weights = (weights / weights.sum()).astype(np.float32)
        """Shape (m,). Sum to one; the middle counts more, so that a depth edge at the rim pulls less."""
        self._stiffness = float((self.weights**2).sum()) / bend_sigma**2 if self.affine else 0.0
        self._basis = np.concatenate((np.ones((1, len(self.offsets))), self.offsets.T)).astype(np.float32)
        """Shape (3, m): one, and the offsets in u and v."""
        self._across = np.ascontiguousarray(self._basis[: 3 if self.affine else 1].T)

    def sample(self, image: Picture, px: Float, linear: Float | None = None) -> Float32:
        """Grey values (n, m) at `px + linear @ offset`; `linear` (n, 2, 2) or None for the identity."""
        if linear is None:
            linear = np.broadcast_to(np.eye(2), (len(px), 2, 2))
        plane = np.concatenate((px[:, :, None], linear), axis=2).astype(np.float32)
        plane[~np.isfinite(px).all(axis=1)] = -10.0
        plane *= image.density
        u, v = plane[:, 0] @ self._basis, plane[:, 1] @ self._basis
        return _float32(cv2.remap(image.values, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE))

    def jacobian(self, gradient: Float32) -> Float32:
        """Derivatives (n, k, m) by shift and, where it is estimated, linear part (row by row), from (n, 2, m)."""
        if not self.affine:
            return gradient.copy()
        u, v = self._basis[1:]
        along_u, along_v = gradient[:, :1], gradient[:, 1:]
        return np.concatenate((gradient, along_u * u, along_u * v, along_v * u, along_v * v), axis=1)

    def bent(self, gradient: Float32) -> Float32:
        """Derivatives (n, 2, m) of the values by the two curvatures of the view, from those by the shift (n, 2, m)."""
        u, v = self._basis[1:]
        along = gradient[:, 0] * u + gradient[:, 1] * v
        return np.stack((along * u, along * v), axis=1)

    def moment(self, weighted_gradient: Float32, difference: Float32) -> Float:
        """`jacobian^T weights difference` (n, k) of centred differences without forming the Jacobian."""
        n, m = difference.shape
        product = (weighted_gradient * difference[:, None, :]).reshape(2 * n, m) @ self._across
        product = product.reshape(n, 2, -1).astype(np.float64)
        if not self.affine:
            return product[:, :, 0]
        return np.concatenate((product[:, :, 0], product[:, 0, 1:], product[:, 1, 1:]), axis=1)

    def prior(self, variance: Float) -> Float:
        """Information (n, k, k) on the linear part, for a noise variance (n,) of normalised samples."""
        weight = np.clip(variance * self._stiffness, 2e-3, 2.0) if self.affine else np.zeros(len(variance))
        size = 6 if self.affine else 2
        return weight[:, None, None] * np.diag(np.repeat((0.0, 1.0), (2, size - 2)))

    def normalise(self, values: Float32) -> tuple[Float32, Float32]:
        """Zero mean, unit variance under the weights; and the standard deviation (n,)."""
        centred = values - (values @ self.weights)[:, None]
        deviation = np.sqrt(np.maximum((centred * centred) @ self.weights, 1e-6))
        centred /= deviation[:, None]
        return centred, deviation


def no_patches(grid: PatchGrid) -> Patches:
    """No patch at all."""
    m = len(grid.weights)
    k = 6 if grid.affine else 2
    square = np.zeros((0, k, k))
    values, gradient = np.zeros((0, m), np.float32), np.zeros((0, 2, m), np.float32)
    two = np.zeros((0, 2, 2))
    return Patches(values, gradient, np.zeros((0, k)), square, square, two, two, np.zeros(0))


def make_patches(image: Picture, px: Float, grid: PatchGrid, variance: float = 0.0) -> Patches:
    """Reference patches (n) about `px` (n, 2) of a smoothed image.

    `variance` is that expected between a patch and its reference, in squared grey values: it weighs the linear part's
    prior.
    """
    if len(px) == 0:
        return no_patches(grid)
    values, deviation = grid.normalise(grid.sample(image, px))
    shift = np.array([[0.5, 0.0], [0.0, 0.5]])
    gradient = np.stack(
        [grid.sample(image, px + step) - grid.sample(image, px - step) for step in shift],
        axis=1,
    )
    gradient /= deviation[:, None, None]
    jacobian = grid.jacobian(gradient)
    weighted = jacobian * grid.weights
    along = (weighted @ values[:, :, None])[:, :, 0]
    # What the normalisation takes out of the differences is taken out of their derivatives.
    jacobian -= weighted.sum(axis=2)[:, :, None] + along[:, :, None] * values[:, None, :]
    weighted = jacobian * grid.weights
    hessian = (weighted @ jacobian.transpose(0, 2, 1)).astype(np.float64)
    variances = deviation.astype(np.float64) ** 2
    prior = grid.prior(variance / variances)
    inverse = np.linalg.inv(hessian + prior + 1e-9 * np.eye(hessian.shape[1]))
    squared = (weighted @ weighted.transpose(0, 2, 1)).astype(np.float64)
    spread = (inverse @ squared @ inverse)[:, :2, :2] / variances[:, None, None]
    bend = inverse[:, :2] @ (weighted @ grid.bent(gradient).transpose(0, 2, 1)).astype(np.float64)
    gradient *= grid.weights
    along = along.astype(np.float64)
    return Patches(values, gradient, along, inverse, inverse @ prior, spread, bend, deviation.astype(np.float64))


def align(
    image: Picture,
    patches: Patches,
    guess: Float,
    linear: Float,
    grid: PatchGrid,
    iterations: int = 9,
    reach_px: float = 3.0,
) -> Alignment:
    """Places (n, 2) in a smoothed image where the reference patches fit best, near `guess` (n, 2).

    Args:
        image: smoothed grey image.
        patches: n reference patches.
        guess: start (n, 2); NaN gives no alignment.
        linear: (n, 2, 2), derivative of this image's pixels by the reference's.
        grid: the grid that the patches were made with.
        iterations: upper limit of Gauss-Newton steps.
        reach_px: a patch that went farther from its guess has not converged.
    """
    px = guess.copy()
    n = len(px)
    difference = np.zeros_like(patches.values)
    converged = np.zeros(n, dtype=bool)
    bend = np.zeros((n, 2, 2))
    index = np.flatnonzero(np.isfinite(guess).all(axis=1))
    now = _Descent(patches, px, linear, grid) if len(index) == n else _Descent(patches, px, linear, grid).take(index)
    for _ in range(iterations):
        if len(index) == 0:
            break
        difference[index] = now.step(image)
        px[index], converged[index] = now.px, now.still
        bend[index] = now.linear
        # Those that are done go on with the rest until they are many: copies cost more than steps.
        if now.still.mean() > _DONE:
            index = index[~now.still]
            now = now.take(~now.still)
    mean_square = (difference**2) @ grid.weights
    visible = inside(px, image.shape, 2.0)
    correlation = np.where(visible, 1.0 - 0.5 * mean_square, -1.0)
    raw_variance = mean_square * patches.contrast**2
    covariance = raw_variance[:, None, None] * (linear @ patches.inverse_hessian @ linear.transpose(0, 2, 1))
    moved = np.linalg.norm(px - guess, axis=1)
    with np.errstate(invalid="ignore"):
        converged &= visible & (moved < reach_px)
    return Alignment(px, correlation, covariance.astype(np.float64), converged, bend)


class _Descent:
    """Gauss-Newton on n patches at once."""

    def __init__(self, patches: Patches, px: Float, linear: Float, grid: PatchGrid) -> None:
        self._patches, self._linear, self._grid = patches, linear, grid
        self.px = px
        self._bend = np.zeros(patches.inverse.shape[:2])
        self._warp = linear
        self.still = np.zeros(len(px), dtype=bool)
        """Which moved less than `_CONVERGED_PX` in the last step."""

    @property
    def linear(self) -> Float:
        """Linear parts (n, 2, 2) that have been found."""
        return self._bend[:, 2:].reshape(-1, 2, 2) if self._grid.affine else np.zeros((len(self.px), 2, 2))

    def take(self, chosen: NDArray[np.intp] | Bool) -> "_Descent":
        """Goes on with some of them."""
        part = _Descent(self._patches.take(chosen), self.px[chosen], self._linear[chosen], self._grid)
        part._bend, part._warp = self._bend[chosen], self._warp[chosen]
        return part

    def step(self, image: Picture) -> Float32:
        """Moves all; the normalised differences (n, m) from before the step."""
        patches, grid = self._patches, self._grid
        difference = grid.normalise(grid.sample(image, self.px, self._warp))[0]
        difference -= patches.values
        moment = grid.moment(patches.gradient, difference)
        moment -= patches.along * ((difference * patches.values) @ grid.weights)[:, None]
        move = (patches.inverse @ moment[:, :, None])[:, :, 0]
        if grid.affine:
            move += (patches.prior @ self._bend[:, :, None])[:, :, 0]
        length = np.sqrt(move[:, 0] ** 2 + move[:, 1] ** 2)
        move *= np.minimum(1.0, _LONGEST_STEP_PX / np.maximum(length, 1e-9))[:, None]
        if grid.affine:
            self._bend[:, 2:] = np.clip(self._bend[:, 2:] - move[:, 2:], -_LARGEST_BEND, _LARGEST_BEND)
            self._warp = self._linear @ (np.eye(2) + self._bend[:, 2:].reshape(-1, 2, 2))
        self.px = self.px - (self._warp @ move[:, :2, None])[:, :, 0]
        self.still = length <= _CONVERGED_PX
        return difference


def _float32(image: object) -> Float32:
    """OpenCV's type stubs know no element type."""
    return np.asarray(image, dtype=np.float32)
