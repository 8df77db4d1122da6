"""A small ray caster for tests: pipes in front of a wall, with the truth about their outlines."""

from dataclasses import dataclass, field

import cv2
import numpy as np

from surecut.factors.camera import CameraModel
from surecut.factors.outline import outline_lines


def camera_model(width=360, height=240, focal=270.0, distortion=None):
    K = np.array([[focal, 0, (width - 1) / 2], [0, focal, (height - 1) / 2], [0, 0, 1.0]])
    model, D = ("none", np.zeros(5)) if distortion is None else ("plumb_bob", np.asarray(distortion, float))
    return CameraModel("m_left", width, height, K, model, D, np.eye(3), None)


@dataclass
class Cylinder:
    point: np.ndarray
    axis: np.ndarray
    radius: float
    albedo: float = 0.6
    specular: float = 0.0
    rust: float = 0.0
    reach: tuple = (-10.0, 10.0)

    def __post_init__(self):
        self.axis = np.asarray(self.axis, float) / np.linalg.norm(self.axis)
        self.point = np.asarray(self.point, float)

    def lines(self, K):
        return outline_lines(self.point, self.axis, self.radius, K)


@dataclass
class Scene:
    cylinders: list
    wall_m: float = 3.0
    wall_tilt: tuple = (0.0, 0.0)
    texture: np.ndarray | None = None
    """Grey texture 0..1, repeated; `texture_scale` px per metre."""
    texture_scale: float = 200.0
    light: tuple = (-0.3, -0.6, -0.75)
    ambient: float = 0.35
    shadow: bool = True
    blur_px: float = 0.4
    noise: float = 2.0
    gain: float = 220.0
    extras: list = field(default_factory=list)


def hit(cylinder, rays):
    """Distance along rays (n, 3) to the cylinder, inf where missed, and the axial coordinate there."""
    d, a = cylinder.axis, cylinder.point
    across = rays - (rays @ d)[:, None] * d
    foot = a - (a @ d) * d
    qa = (across**2).sum(1)
    qb = across @ foot
    disc = qb**2 - qa * (foot @ foot - cylinder.radius**2)
    t = np.where(disc > 0, (qb - np.sqrt(np.maximum(disc, 0))) / qa, np.inf)
    with np.errstate(invalid="ignore"):
        s = t * (rays @ d) - a @ d
    ok = (disc > 0) & (t > 0) & (s > cylinder.reach[0]) & (s < cylinder.reach[1])
    return np.where(ok, t, np.inf), s


def shadowed(points, light, cylinders):
    dark = np.zeros(len(points), bool)
    for c in cylinders:
        d = c.axis
        lo = light - (light @ d) * d
        rel = points - c.point
        ro = rel - (rel @ d)[:, None] * d
        n = lo @ lo
        t = -(ro @ lo) / n
        dist = np.linalg.norm(ro + t[:, None] * lo, axis=1)
        s = (rel + t[:, None] * light) @ d
        dark |= (t > 1e-3) & (dist < c.radius) & (s > c.reach[0]) & (s < c.reach[1])
    return dark


def shade(scene, rays):
    light = np.asarray(scene.light, float)
    light = light / np.linalg.norm(light)
    best = np.full(len(rays), np.inf)
    value = np.zeros(len(rays))
    normal = np.array([scene.wall_tilt[0], scene.wall_tilt[1], -1.0])
    normal /= np.linalg.norm(normal)
    t = (normal @ np.array([0, 0, scene.wall_m])) / (rays @ normal)
    t = np.where(t > 0, t, 50.0)
    p = rays * t[:, None]
    base = np.full(len(rays), 0.5)
    if scene.texture is not None:
        uv = p[:, :2] * scene.texture_scale
        size = scene.texture.shape[0]
        uv = np.mod(uv, size - 1).astype(np.float32).reshape(-1, np.gcd(len(uv), 14400), 2)
        base = cv2.remap(scene.texture.astype(np.float32), uv, None, cv2.INTER_LINEAR).ravel()
    lit = max(normal @ light, 0.0) * np.ones(len(rays))
    if scene.shadow:
        lit = np.where(shadowed(p, light, scene.cylinders), 0.0, lit)
    value, best = base * (scene.ambient + lit), t
    rng = np.random.default_rng(5)
    for c in scene.cylinders:
        t, s = hit(c, rays)
        win = t < best
        p = rays[win] * t[win, None]
        n = (p - c.point) - ((p - c.point) @ c.axis)[:, None] * c.axis
        n /= np.linalg.norm(n, axis=1, keepdims=True)
        view = -rays[win] / np.linalg.norm(rays[win], axis=1, keepdims=True)
        half = view + light
        half /= np.linalg.norm(half, axis=1, keepdims=True)
        lit = (
            c.albedo * (scene.ambient + np.maximum(n @ light, 0)) + c.specular * np.maximum((n * half).sum(1), 0) ** 40
        )
        if c.rust:
            e = np.cross(c.axis, [0.3, 0.5, 0.8])
            e /= np.linalg.norm(e)
            phi = np.arctan2(n @ np.cross(c.axis, e), n @ e)
            waves = sum(
                np.sin(rng.uniform(5, 60) * s[win] + rng.integers(1, 6) * phi + rng.uniform(0, 6)) for _ in range(8)
            )
            lit = lit * (1 + c.rust * waves / 4)
        value[win] = lit
        best = np.minimum(best, t)
    return value


def render(scene, camera, rng, oversample=4):
    """Grey image uint8 of the camera, raw (distorted)."""
    from surecut.frontends.undistort import undistort

    o = (np.arange(oversample) + 0.5) / oversample - 0.5
    u = (np.arange(camera.width)[:, None] + o).ravel()
    v = (np.arange(camera.height)[:, None] + o).ravel()
    uu, vv = np.meshgrid(u, v)
    if camera.distortion_model == "none":
        xy = np.column_stack(((uu.ravel() - camera.cx) / camera.fx, (vv.ravel() - camera.cy) / camera.fy))
    else:
        ideal = undistort(camera, np.column_stack((uu.ravel(), vv.ravel())))[0]
        xy = (ideal - (camera.cx, camera.cy)) / (camera.fx, camera.fy)
    rays = np.column_stack((xy, np.ones(len(xy))))
    fine = shade(scene, rays).reshape(camera.height, oversample, camera.width, oversample)
    image = fine.mean(axis=(1, 3)) * scene.gain
    if scene.blur_px > 0:
        image = cv2.GaussianBlur(image, (0, 0), scene.blur_px)
    image = image + rng.normal(0, scene.noise, image.shape)
    return np.clip(np.round(image), 0, 255).astype(np.uint8)


def noise_texture(rng, size=512, octaves=5, contrast=0.5):
    out = np.zeros((size, size))
    for k in range(octaves):
        n = 4 * 2**k
        out += cv2.resize(rng.normal(size=(n, n)), (size, size), interpolation=cv2.INTER_CUBIC) / 1.6**k
    out = (out - out.mean()) / out.std()
    return np.clip(0.5 + 0.3 * contrast * out, 0.02, 1)


def brick_texture(rng, size=512, contrast=0.5):
    out = noise_texture(rng, size, contrast=contrast * 0.5)
    for r in range(0, size, 32):
        out[r : r + 4] = 0.75
        for c in range((r // 32 % 2) * 32, size, 64):
            out[r : r + 32, c : c + 4] = 0.75
    return out


def random_case(rng, difficulty=1.0):
    """A pipe in front of a wall, with what makes outlines hard; the pipe is the first cylinder."""
    z = rng.uniform(0.8, 2.2)
    radius = rng.uniform(0.03, 0.055)
    px = rng.uniform([80, 60], [280, 180])
    tilt = rng.normal(0, 0.35)
    if rng.random() < 0.25:
        tilt += np.pi / 2
    axis = np.array([np.sin(tilt), np.cos(tilt), rng.normal(0, 0.3)])
    K = camera_model().K
    point = np.linalg.inv(K) @ np.append(px, 1) * z
    pipe = Cylinder(point, axis, radius, rng.uniform(0.2, 0.9), rng.choice([0, 0.3, 0.8]), rng.choice([0, 0.1, 0.3]))
    cylinders = [pipe]
    side = np.cross(pipe.axis, point / z)
    side /= np.linalg.norm(side)
    if rng.random() < 0.4 * difficulty:  # a neighbour, nearly parallel
        gap = rng.uniform(3.5, 7) * radius * rng.choice([-1, 1])
        cylinders.append(
            Cylinder(
                point + side * gap + np.array([0, 0, rng.uniform(0, 0.1)]),
                pipe.axis + rng.normal(0, 0.02, 3),
                rng.uniform(0.02, 0.06),
                rng.uniform(0.2, 0.9),
                0.3,
            )
        )
    if rng.random() < 0.4 * difficulty:  # flanges
        at = rng.uniform(0.08, 0.3) * rng.choice([-1, 1])
        cylinders.append(
            Cylinder(point, pipe.axis, radius * 1.5, pipe.albedo, pipe.specular, 0, (at - 0.02, at + 0.02))
        )
    if rng.random() < 0.3 * difficulty:  # something in front, away from the pick
        at = point + pipe.axis * rng.uniform(0.12, 0.3) * rng.choice([-1, 1]) + np.array([0, 0, -0.25])
        cylinders.append(
            Cylinder(at, np.cross(pipe.axis, [0, 0, 1]) + rng.normal(0, 0.3, 3), 0.03, rng.uniform(0.1, 0.9))
        )
    kind = rng.choice(["plain", "noise", "brick"])
    texture = {
        "plain": lambda: None,
        "noise": lambda: noise_texture(rng, contrast=rng.uniform(0.2, 0.8)),
        "brick": lambda: brick_texture(rng),
    }[kind]()
    light = np.array([rng.uniform(-0.8, 0.8), rng.uniform(-0.9, 0.2), -rng.uniform(0.3, 1)])
    return Scene(
        cylinders,
        z + rng.uniform(0.15, 1.5),
        tuple(rng.normal(0, 0.2, 2)),
        texture,
        rng.uniform(150, 350),
        tuple(light),
        rng.uniform(0.4, 0.9),
        True,
        rng.uniform(0.3, 0.8),
        rng.uniform(1, 4),
        rng.uniform(110, 180),
    )


def pick_on(scene, camera, rng, sigma=1.5):
    """A click on the middle of the pipe's outline at its point, ideal pixels, and the true lines."""
    pipe = scene.cylinders[0]
    lines = pipe.lines(camera.K)
    p = camera.K @ pipe.point
    p = p[:2] / p[2]
    d = lines[:, :2] @ p + lines[:, 2]
    n = lines[0, :2] - lines[1, :2]
    n /= np.linalg.norm(n)
    middle = p - n * (d[0] - d[1]) / 2 / ((n @ lines[0, :2]) if True else 1)
    return middle + rng.normal(0, sigma, 2), lines


def visible_share(scene, camera):
    """Part of the pipe's two edges, within 35 px of its point, that nothing hides and that lies in the image."""
    pipe = scene.cylinders[0]
    lines = pipe.lines(camera.K)
    p = camera.K @ pipe.point
    p = p[:2] / p[2]
    shares = []
    for line in [*lines, None]:
        if line is None:
            px = p + np.linspace(-3, 3, 7)[:, None] * np.array([-lines[0, 1], lines[0, 0]])
        else:
            foot = p - (line[:2] @ p + line[2]) * line[:2]
            px = foot - 0.3 * line[:2] + np.linspace(-35, 35, 71)[:, None] * np.array([-line[1], line[0]])
        rays = np.column_stack((px, np.ones(len(px)))) @ np.linalg.inv(camera.K).T
        first = hit(pipe, rays)[0]
        others = [hit(c, rays)[0] for c in scene.cylinders[1:]]
        seen = np.isfinite(first) & (first < np.min([np.full(len(px), scene.wall_m * 3), *others], axis=0))
        seen &= (px > 0).all(1) & (px[:, 0] < camera.width) & (px[:, 1] < camera.height)
        if line is not None:  # nothing hides the background beside the edge either
            beside = rays + (line[:2] * 2.5 / camera.fx).tolist() @ np.eye(2, 3)
            seen &= ~np.any(
                [np.isfinite(hit(c, beside)[0]) & (hit(c, beside)[0] < first) for c in scene.cylinders[1:]]
                or [np.zeros(len(px), bool)],
                axis=0,
            )
        shares.append(seen.mean())
    return min(shares)
