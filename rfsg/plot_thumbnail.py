"""The picture of one object: seen from before and above, lit from the left, on a floor that it shades.

Triangles are met by Embree; colour is a sun with a soft shadow, and a sky that is dimmed where the
object hides it from itself. No window, no graphics card; the same mesh gives the same picture.
"""

import io
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

if TYPE_CHECKING:
    from rfsg.tracer.triangles import Triangles

SIDE = 320  # [pixels]
SAMPLES = 4  # each way in a pixel
SKY_RAYS = 3  # for each sample
FIELD_DEG = 24.0  # of the camera's view
AZIMUTH_DEG, ELEVATION_DEG = 38.0, 22.0  # where the camera stands; an object's front is +x
SUN = (0.25, -0.75, 1.0)  # towards the sun
SUN_SIZE = 0.13  # radius of the sun at distance 1: how soft its shadow is
SUNLIGHT, SKYLIGHT = 0.62, 0.62  # what of full white each gives to a face that looks at it
FROM_BELOW = 0.45  # what the floor sends back of the sky's light
FLOOR = 0.94  # how bright the floor is in the open
MARGIN = 1.12  # the frame, in sizes of the object
BAND = 32  # rows of pixels at a time: bounds memory
R2 = 1.32471795724474602596  # x^3 = x + 1
LIFT = 1e-4  # of the object's size: a second ray starts so far off what the first met


def thumbnail(
    vertices: Float[ndarray, "v 3"],
    faces: Int[ndarray, "t 3"],
    normals: Float[ndarray, "v 3"],
    color: Sequence[float] = (0.55, 0.57, 0.6),
    side: int = SIDE,
) -> bytes:
    """A PNG of a mesh [m], z up, with unit vertex normals. color: linear RGB. side: [pixels]."""
    import torch

    from rfsg.objects.shapes.shown import corner_normals
    from rfsg.tracer.triangles import Triangles

    low, high = vertices.min(0), vertices.max(0)
    middle, size = (low + high) / 2, float(np.linalg.norm(high - low))
    local = (vertices - middle) / size
    corners = local[faces]
    scene = Triangles(torch.from_numpy(corners).double())
    eye, rays = _camera(local, side * SAMPLES)
    smooth = corner_normals(vertices, faces, normals)
    view = _View(scene, corners, smooth, local[:, 2].min(), np.asarray(color, float))
    dice = _dice(side)
    rows = np.array_split(np.arange(side * SAMPLES), max(1, side // BAND))
    image = np.concatenate([view.light(eye, rays[r], dice[r]) for r in rows])
    return _png(_srgb(image.reshape(side, SAMPLES, side, SAMPLES, 3).mean((1, 3))))


def _camera(local: ndarray, n: int) -> tuple[ndarray, ndarray]:
    """The eye, and unit directions [n n 3] through a square that holds all vertices."""
    azimuth, elevation = np.radians([AZIMUTH_DEG, ELEVATION_DEG])
    flat = np.cos(elevation)
    back = np.array([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)])
    right = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
    up = np.cross(back, right)
    eye = back * 0.5 / np.tan(np.radians(FIELD_DEG) / 2) * 1.4
    seen = local - eye
    depth = seen @ -back
    across, above = seen @ right / depth, seen @ up / depth
    half = MARGIN * max(np.ptp(across), np.ptp(above)) / 2
    step = (np.arange(n) + 0.5) / n * 2 - 1
    x = (across.max() + across.min()) / 2 + half * step
    y = (above.max() + above.min()) / 2 - half * step
    rays = -back + x[None, :, None] * right + y[:, None, None] * up
    return eye, rays / np.linalg.norm(rays, axis=-1, keepdims=True)


def _dice(side: int) -> ndarray:
    """For each sample [n n] its place in a sequence that fills the unit square evenly, shifted from
    pixel to pixel: [n n 3], an index and the shift."""
    n = side * SAMPLES
    row, column = np.indices((n, n))
    index = (row % SAMPLES) * SAMPLES + column % SAMPLES
    shift = np.random.default_rng(0).random((side, side, 2))
    return np.concatenate([index[..., None], shift[row // SAMPLES, column // SAMPLES]], -1)


def _fair(dice: ndarray, k: int, of: int) -> tuple[ndarray, ndarray]:
    """The k-th of ``of`` points of each sample in the unit square: the R2 sequence (Roberts 2018)."""
    index = dice[:, 0] * of + k
    u, v = (np.mod(dice[:, i] + index * R2**-i, 1.0) for i in (1, 2))
    return u, v


class _View:
    """Triangles in Embree, their corners and corner normals [t 3 3], and the floor below them."""

    def __init__(
        self, scene: "Triangles", corners: ndarray, normals: ndarray, floor: float, color: ndarray
    ):
        self.scene, self.corners, self.normals = scene, corners, normals
        self.floor, self.color = floor, color

    def light(self, eye: ndarray, rays: ndarray, dice: ndarray) -> ndarray:
        """Linear RGB [r n 3] along rays from the eye."""
        ray, dice = rays.reshape(-1, 3), dice.reshape(-1, 3)
        out = np.ones((len(ray), 3))
        triangle, distance = self._first(np.broadcast_to(eye, ray.shape), ray)
        met = triangle >= 0
        point = eye + distance[met, None] * ray[met]
        normal = self._normal(triangle[met], point)
        normal *= np.where((normal * ray[met]).sum(-1) > 0, -1.0, 1.0)[:, None]
        out[met] = self.color * self._lit(point, normal, dice[met])[:, None]
        below = ~met & (ray[:, 2] < 0)
        reach = (self.floor - eye[2]) / ray[below, 2]
        ground = eye + reach[:, None] * ray[below]
        level = np.broadcast_to([0.0, 0.0, 1.0], ground.shape)
        lit = self._lit(ground, level, dice[below])
        # the floor fades into the white of the page
        near = np.exp(-((np.linalg.norm(ground[:, :2], axis=-1) / 0.9) ** 2))
        shade = lit / (SUNLIGHT * _sun()[2] + SKYLIGHT)
        out[below] = (1 - near * (1 - FLOOR * shade))[:, None]
        return out.reshape(rays.shape)

    def _lit(self, point: ndarray, normal: ndarray, dice: ndarray) -> ndarray:
        """How much light arrives: the sun where it is seen, and the sky."""
        start = point + LIFT * normal
        sun = _sun() + SUN_SIZE * _sphere(*_fair(dice, 0, 1))
        sun /= np.linalg.norm(sun, axis=-1, keepdims=True)
        facing = np.clip((normal * sun).sum(-1), 0, None)
        light = SUNLIGHT * facing * (self._first(start, sun)[0] < 0)
        for k in range(SKY_RAYS):
            # a matt face weighs directions by their cosine: the normal and a point of a unit sphere
            sky = normal + _sphere(*_fair(dice, k, SKY_RAYS))
            sky /= np.linalg.norm(sky, axis=-1, keepdims=True).clip(1e-9)
            bright = np.where(sky[:, 2] > 0, 1.0, FROM_BELOW)
            light += SKYLIGHT / SKY_RAYS * bright * (self._first(start, sky)[0] < 0)
        return light

    def _first(self, origin: ndarray, direction: ndarray) -> tuple[ndarray, ndarray]:
        import torch

        found = self.scene.first(
            torch.from_numpy(np.ascontiguousarray(origin)), torch.from_numpy(direction)
        )
        return found[0].numpy(), found[1].numpy()

    def _normal(self, triangle: ndarray, point: ndarray) -> ndarray:
        """The corners' normals, mixed by areas as seen from the point."""
        a, b, c = (self.corners[triangle, k] for k in range(3))
        whole = np.cross(b - a, c - a)
        square = (whole * whole).sum(-1).clip(1e-30)
        v = (np.cross(point - a, c - a) * whole).sum(-1) / square
        w = (np.cross(b - a, point - a) * whole).sum(-1) / square
        share = np.stack([1 - v - w, v, w], -1).clip(0, 1)
        normal = (share[:, :, None] * self.normals[triangle]).sum(1)
        length = np.linalg.norm(normal, axis=-1, keepdims=True)
        return np.where(length > 1e-6, normal / length.clip(1e-6), whole / np.sqrt(square)[:, None])


def _sphere(u: ndarray, v: ndarray) -> ndarray:
    """Points of the unit sphere, evenly for (u, v) of the unit square."""
    z, turn = 1 - 2 * u, 2 * np.pi * v
    flat = np.sqrt((1 - z * z).clip(0))
    return np.stack([flat * np.cos(turn), flat * np.sin(turn), z], -1)


def _sun() -> ndarray:
    sun = np.array(SUN)
    return sun / np.linalg.norm(sun)


def _srgb(linear: ndarray) -> ndarray:
    """IEC 61966-2-1."""
    x = linear.clip(0, 1)
    return np.where(x <= 0.0031308, 12.92 * x, 1.055 * x ** (1 / 2.4) - 0.055)


def _png(image: ndarray) -> bytes:
    from rfsg.plot import Figure

    dpi = 100
    figure = Figure(figsize=(image.shape[1] / dpi, image.shape[0] / dpi), dpi=dpi)
    figure.figimage(image)
    file = io.BytesIO()
    figure.savefig(file, format="png", dpi=dpi, metadata={"Software": None})
    return file.getvalue()
