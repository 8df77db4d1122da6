"""A textured room of planes for tests of the stereo front end, with the truth about pose and depth."""

from dataclasses import dataclass, field

import cv2
import numpy as np

from surecut.factors.camera import CameraModel

WIDTH, HEIGHT, FOCAL, BASELINE = 360, 240, 270.0, 0.15
K = np.array([[FOCAL, 0, (WIDTH - 1) / 2], [0, FOCAL, (HEIGHT - 1) / 2], [0, 0, 1.0]])
SUPERSAMPLING = 2


def camera(name="m_left", distortion=None):
    model, D = ("none", np.zeros(0)) if distortion is None else ("plumb_bob", np.asarray(distortion, float))
    return CameraModel(name, WIDTH, HEIGHT, K, model, D, np.eye(3), BASELINE if name == "m_right" else 0.0)


def left_T_right():
    pose = np.eye(4)
    pose[0, 3] = BASELINE
    return pose


def pose(yaw, pitch, roll, position):
    a_T_b = np.eye(4)
    for vector in ((0, yaw, 0), (pitch, 0, 0), (0, 0, roll)):
        a_T_b[:3, :3] = a_T_b[:3, :3] @ cv2.Rodrigues(np.array(vector, float))[0]
    a_T_b[:3, 3] = position
    return a_T_b


def texture(rng, height, width):
    """Cloudy noise with a spectrum like photographs', and polygons with sharp edges."""
    frequency = np.hypot(np.fft.fftfreq(height)[:, None], np.fft.fftfreq(width)[None])
    spectrum = np.fft.fft2(rng.standard_normal((height, width))) / np.maximum(frequency, 1 / height)
    cloud = np.fft.ifft2(spectrum).real
    image = np.ascontiguousarray(120 + 14 * cloud / cloud.std(), dtype=np.float32)
    for _ in range(height * width // 4000):
        angles = np.sort(rng.uniform(0, 2 * np.pi, rng.integers(3, 7)))
        outline = rng.uniform(0, (width, height)) + rng.uniform(8, 45) * np.stack((np.cos(angles), np.sin(angles)), 1)
        mask = cv2.fillPoly(np.zeros((height, width), np.uint8), [outline.astype(np.int32)], 1)
        image[mask > 0] += rng.normal(0, 40)
    return np.clip(image, 10, 245)


@dataclass
class Plane:
    """A rectangle from a corner along two edges."""

    corner: np.ndarray
    across: np.ndarray
    down: np.ndarray
    image: np.ndarray

    def small(self, level):
        image = self.image
        for _ in range(level):
            image = cv2.resize(image, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
        return image


@dataclass
class Room:
    """4 m wide, 2.4 m high; the back wall 2 m ahead of the origin, two posters, a floor."""

    seed: int = 0
    planes: list = field(default_factory=list)

    def __post_init__(self):
        rng = np.random.default_rng(self.seed)
        for corner, across, down in (
            ((-2, -1.2, 2), (4, 0, 0), (0, 2.4, 0)),
            ((-2, -1.2, -2), (0, 0, 4), (0, 2.4, 0)),
            ((2, -1.2, -2), (0, 0, 4), (0, 2.4, 0)),
            ((-2, 1.2, -2), (4, 0, 0), (0, 0, 4)),
            ((-2, -1.2, -2), (4, 0, 0), (0, 0, 4)),
            ((-0.9, -0.4, 0.9), (0.5, 0, 0.2), (0, 0.6, 0)),
            ((0.4, -0.1, 0.7), (0.5, 0, -0.15), (0, 0.5, 0.1)),
        ):
            across, down = np.array(across, float), np.array(down, float)
            size = [round(220 * np.linalg.norm(edge)) for edge in (down, across)]
            self.planes.append(Plane(np.array(corner, float), across, down, texture(rng, *size)))

    def render(self, o_T_m):
        """Image (float) and depth along the optical axis, both (HEIGHT, WIDTH)."""
        s = SUPERSAMPLING
        matrix = np.array([[s, 0, (s - 1) / 2], [0, s, (s - 1) / 2], [0, 0, 1.0]]) @ K
        u, v = np.meshgrid(np.arange(WIDTH * s, dtype=np.float32), np.arange(HEIGHT * s, dtype=np.float32))
        nearness, image = np.zeros_like(u), np.zeros_like(u)
        for plane in self.planes:
            _draw(plane, o_T_m, matrix, u, v, nearness, image)
        depth = 1.0 / np.maximum(nearness[s // 2 :: s, s // 2 :: s], 1e-6)
        image = cv2.resize(image, (WIDTH, HEIGHT), interpolation=cv2.INTER_AREA)
        return cv2.GaussianBlur(image, (0, 0), 0.6), depth

    def pair(self, o_T_m):
        """Left image, right image and left depth."""
        left, depth = self.render(o_T_m)
        return left, self.render(o_T_m @ left_T_right())[0], depth


def _draw(plane, o_T_m, matrix, u, v, nearness, image):
    height, width = plane.image.shape
    R, position = o_T_m[:3, :3], o_T_m[:3, 3]
    normal = np.cross(plane.across, plane.down)
    ahead = (R.T @ normal @ np.linalg.inv(matrix)) / (normal @ (plane.corner - position))
    inverse_depth = (u * ahead[0] + v * ahead[1] + ahead[2]).astype(np.float32)
    columns = (plane.across / width, plane.down / height)
    first = plane.corner + 0.5 * (columns[0] + columns[1]) - position
    back = np.linalg.inv(matrix @ R.T @ np.stack((*columns, first), axis=1)).astype(np.float32)
    with np.errstate(divide="ignore", invalid="ignore"):
        w = u * back[2, 0] + v * back[2, 1] + back[2, 2]
        x = (u * back[0, 0] + v * back[0, 1] + back[0, 2]) / w
        y = (u * back[1, 0] + v * back[1, 1] + back[1, 2]) / w
        seen = (inverse_depth > nearness) & (x > -0.5) & (y > -0.5) & (x < width - 0.5) & (y < height - 0.5)
    if not seen.any():
        return
    texels_per_px = np.median(1.0 / inverse_depth[seen]) / matrix[0, 0] * width / np.linalg.norm(plane.across)
    level = int(np.clip(np.log2(max(texels_per_px, 1.0)), 0, 4))
    scale = np.float32(0.5**level)
    samples = cv2.remap(
        plane.small(level),
        (x + np.float32(0.5)) * scale - np.float32(0.5),
        (y + np.float32(0.5)) * scale - np.float32(0.5),
        cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_REPLICATE,
    )
    image[seen], nearness[seen] = samples[seen], inverse_depth[seen]


def expose(image, rng, noise=2.0, gain=1.0):
    """An 8-bit photograph of a rendering."""
    return np.clip(np.rint(image * gain + rng.normal(0, noise, image.shape)), 0, 255).astype(np.uint8)
