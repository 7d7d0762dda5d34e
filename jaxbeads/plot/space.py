"""Beads in space as lit spheres: an orthographic camera, and a raster in which what is nearer covers
what is farther away, point by point.
"""

from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes

from .._checks import fail
from .base import View

_FINE = 2  # points of the raster for one of the picture, along each axis
_PAPER, _FLOOR, _WALL = 1.0, 0.955, 0.86
_SHADOW = 0.72


def _unit(vector: np.ndarray) -> np.ndarray:
    return vector / np.linalg.norm(vector)


# Where light comes from in the frame of the camera (right, up, to the viewer), and a mirror's normal.
_LIGHT = _unit(np.array([-0.42, 0.62, 0.66], np.float32))
_HALF = _unit(_LIGHT + np.array([0.0, 0.0, 1.0], np.float32))


def _upwards(view: View, wall: tuple[np.ndarray, np.ndarray] | None) -> np.ndarray:
    if view.up is not None:
        up = np.asarray(view.up, float)
        if up.shape != (3,) or not np.all(np.isfinite(up)) or not np.any(up):
            fail("up", "be a direction in space", f"it is {view.up}")
        return _unit(up)
    if wall is None:
        return np.array([0.0, 0.0, 1.0])
    normal = wall[1]
    return _unit(normal * np.sign(normal[np.argmax(np.abs(normal))]))


def _horizontal(up: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Two directions at right angles to `up`: coordinate axes if it is one."""
    k = int(np.argmax(np.abs(up)))
    first = np.eye(3)[(k + 1) % 3]
    first = _unit(first - (first @ up) * up)
    return first, np.cross(up, first)


def camera(view: View, points: np.ndarray, up: np.ndarray) -> np.ndarray:
    """Directions to the right, up and to the viewer, as rows, for points `(n, 3)` to be seen well."""
    first, second = _horizontal(up)
    azimuth = view.azimuth
    if azimuth is None:
        flat = np.stack([points @ first, points @ second])
        spread = np.cov(flat) if points.shape[0] > 1 else np.eye(2)
        along = np.linalg.eigh(spread + 1e-12 * np.diag([2.0, 1.0]))[1][:, -1]
        along = along * np.sign(along[np.argmax(np.abs(along))])
        azimuth = np.degrees(np.arctan2(along[1], along[0])) - 90 + 25
    if not -90 <= view.elevation <= 90:
        fail("elevation", "lie between -90 and 90 degrees", f"it is {view.elevation}")
    phi, theta = np.radians(azimuth), np.radians(view.elevation)
    away = np.cos(phi) * first + np.sin(phi) * second
    right = np.cos(phi) * second - np.sin(phi) * first
    viewer = np.cos(theta) * away + np.sin(theta) * up
    return np.stack([right, np.cross(viewer, right), viewer])


def _round(step: float) -> float:
    """The nearest of 1, 2, 5, 10, ..."""
    every = np.outer(10.0 ** np.arange(-6, 7), [1, 2, 5]).ravel()
    return float(every[np.argmin(np.abs(np.log(every / step)))])


def _box(
    low: np.ndarray, step: float, shape: tuple[int, ...], centre: np.ndarray, r: float
) -> tuple[tuple[slice, slice], np.ndarray, np.ndarray]:
    """The part of a raster about a disc, and its points from the centre over the radius."""
    spans, offsets = [], []
    for k, number in ((1, shape[0]), (0, shape[1])):
        first, last = ((centre[k] + sign * r - low[k]) / step for sign in (-1, 1))
        span = slice(max(0, int(first)), max(0, min(number, int(last) + 2)))
        spans.append(span)
        points = low[k] + step * (np.arange(span.start, span.stop) + 0.5)
        offsets.append(((points - centre[k]) / r).astype(np.float32))
    return (spans[0], spans[1]), offsets[1][None, :], offsets[0][:, None]


@dataclass(frozen=True)
class Floor:
    """A plane of squares below the beads: the domain's, or one that is there to show depth and scale.

    `axes`: two directions in it and its normal, as rows; `low`, `high`: its sides along the first two,
    and `level`, where it lies along the third; `square`: side of its squares.
    """

    axes: np.ndarray
    low: np.ndarray
    high: np.ndarray
    level: float
    square: float
    solid: bool

    @classmethod
    def below(
        cls,
        points: np.ndarray,
        radius: float,
        up: np.ndarray,
        wall: tuple[np.ndarray, np.ndarray] | None,
    ) -> "Floor":
        """Below (along `up`, or the wall's normal) points `(n, 3)` of beads of at most a radius."""
        normal = up if wall is None else _unit(wall[1])
        axes = np.stack([*_horizontal(normal), normal])
        place = points @ axes.T
        low, high = place.min(axis=0) - radius, place.max(axis=0) + radius
        wide = max(high - low)
        square = _round(wide / 7)
        level = low[2] - 0.08 * wide if wall is None else float(wall[0] @ normal)
        margin = 0.2 * square
        first = np.floor((low[:2] - margin) / square) * square
        last = np.ceil((high[:2] + margin) / square) * square
        return cls(axes, first, last, level, square, wall is not None)

    @property
    def corners(self) -> np.ndarray:
        """In the order of its outline, `(4, 3)`."""
        (a, b), (c, d) = self.low, self.high
        place = np.array([[x, y, self.level] for x, y in ((a, b), (c, b), (c, d), (a, d))])
        return place @ self.axes


class Stage:
    """A camera and a raster of fixed size, in which beads are painted.

    **Arguments**: the view; all points that will be shown, `(n, 3)`, and the largest radius, in units of
    the length.
    """

    def __init__(self, view: View, points: np.ndarray, radius: float, length: float) -> None:
        if view.stretch != 1:
            fail("stretch", "be 1 in space (a `plane` can be stretched)", f"it is {view.stretch:g}")
        points = points.reshape(-1, 3)
        wall = view.wall(points, length)
        up = _upwards(view, wall)
        self.camera = camera(view, points, up)
        if wall is not None and self.camera[2] @ _unit(wall[1]) < 0.05:
            wall = None  # it would hide the beads, as a surface above them
        self.floor = Floor.below(points, radius, up, wall)
        seen = points @ self.camera.T
        self.near, self.far = seen[:, 2].max() + radius, seen[:, 2].min() - radius
        corners = (self.floor.corners @ self.camera.T)[:, :2]
        low = np.minimum(seen[:, :2].min(axis=0) - radius, corners.min(axis=0))
        high = np.maximum(seen[:, :2].max(axis=0) + radius, corners.max(axis=0))
        margin = 0.015 * max(high - low)
        self.low, self.high = low - margin, high + margin

    def resize(self, low: np.ndarray, high: np.ndarray, width: int) -> None:
        """Fix the limits of the picture and its width in points."""
        self.low, self.high = low, high
        self.step = (high - low)[0] / width
        self.shape = (round((high - low)[1] / self.step), width)
        self._background()

    @property
    def extent(self) -> tuple[float, float, float, float]:
        """Left, right, bottom, top of the picture."""
        high = self.low + self.step * np.array(self.shape[::-1])
        return float(self.low[0]), float(high[0]), float(self.low[1]), float(high[1])

    def _background(self) -> None:
        rows, columns = self.shape
        x = (self.low[0] + self.step * (np.arange(columns) + 0.5))[None, :]
        y = (self.low[1] + self.step * (np.arange(rows) + 0.5))[:, None]
        floor, tilt = (
            self.floor,
            self.camera @ self.floor.axes.T,
        )  # of the camera's axes on the floor's
        self.from_above = bool(tilt[2, 2] > 0.05)
        self.paper = np.full(self.shape, _PAPER, np.float32)
        self.place = np.zeros((*self.shape, 2), np.float32)
        if not self.from_above:
            return
        deep = (floor.level - x * tilt[0, 2] - y * tilt[1, 2]) / tilt[2, 2]
        inside = np.ones(self.shape, bool)
        lines = np.zeros(self.shape, np.float32)
        for k in range(2):
            along = x * tilt[0, k] + y * tilt[1, k] + deep * tilt[2, k]
            self.place[..., k] = along
            inside &= (along >= floor.low[k]) & (along <= floor.high[k])
            off = np.abs(along / floor.square - np.round(along / floor.square)) * floor.square
            change = np.hypot(*(tilt[i, k] - tilt[i, 2] * tilt[2, k] / tilt[2, 2] for i in (0, 1)))
            lines = np.maximum(lines, np.clip(1.6 - off / (change * self.step), 0, 1))
        shade = _WALL if floor.solid else _FLOOR
        self.paper[inside] = (shade - 0.1 * lines)[inside]

    def paint(self, centres: np.ndarray, radii: np.ndarray, colours: np.ndarray) -> np.ndarray:
        """Beads at centres `(n, 3)` with colours `(n, 3)`: a picture `(rows, columns, 3)` of bytes, from
        its lowest row on.
        """
        seen = centres @ self.camera.T
        grey = self.paper.copy()
        if self.from_above:
            self._shade(grey, centres, radii)
        picture = np.repeat(grey[..., None], 3, axis=2)
        # Edges are smooth: where beads are, a finer raster is painted and averaged.
        corner = [
            int(k) for k in ((seen[:, :2] - radii[:, None]).min(axis=0) - self.low) / self.step
        ]
        corner = [max(k, 0) for k in corner]
        far = ((seen[:, :2] + radii[:, None]).max(axis=0) - self.low) / self.step
        part = tuple(slice(k, int(end) + 2) for k, end in zip(corner, far, strict=True))[::-1]
        fine = picture[part].repeat(_FINE, axis=0).repeat(_FINE, axis=1)
        low = self.low + self.step * np.array(corner)
        self._spheres(fine, low, self.step / _FINE, seen, radii, colours)
        parts = (fine[i::_FINE, j::_FINE] for i in range(_FINE) for j in range(_FINE))
        picture[part] = sum(parts) / _FINE**2
        return (255 * np.clip(picture, 0, 1) + 0.5).astype(np.uint8)

    def _spheres(
        self,
        picture: np.ndarray,
        low: np.ndarray,
        step: float,
        seen: np.ndarray,
        radii: np.ndarray,
        colours: np.ndarray,
    ) -> None:
        """Paint spheres at places `seen` by the camera on a raster from `low` on."""
        depth = np.full(picture.shape[:2], -np.inf, np.float32)
        deep = max(self.near - self.far, 1e-12)
        for (x, y, z), r, colour in zip(seen, radii, colours.astype(np.float32), strict=True):
            box, dx, dy = _box(low, step, picture.shape, np.array([x, y]), r)
            square = 1 - dx**2 - dy**2
            height = np.sqrt(np.maximum(square, 0))
            front = (square > 0) & (z + r * height > depth[box])
            bright = np.maximum(dx * _LIGHT[0] + dy * _LIGHT[1] + height * _LIGHT[2], 0)
            shine = np.maximum(dx * _HALF[0] + dy * _HALF[1] + height * _HALF[2], 0) ** 32
            rim = 0.55 + 0.45 * np.minimum(height / 0.45, 1)
            haze = np.float32(0.3 * (self.near - z) / deep)
            lit = ((0.42 + 0.68 * bright) * rim)[..., None] * colour + 0.35 * shine[..., None]
            lit = (1 - haze) * np.minimum(lit, 1) + haze * np.float32(0.97)
            np.copyto(picture[box], lit, where=front[..., None])
            np.copyto(depth[box], z + r * height, where=front)

    def _shade(self, grey: np.ndarray, centres: np.ndarray, radii: np.ndarray) -> None:
        """Shadows straight below the beads, soft at the edge."""
        feet = centres @ self.floor.axes.T
        feet[:, 2] = self.floor.level
        dark = np.zeros(self.shape, np.float32)
        for foot, seen, r in zip(feet, feet @ self.floor.axes @ self.camera.T, radii, strict=True):
            box, _, _ = _box(self.low, self.step, self.shape, seen[:2], 1.3 * r)
            off = np.hypot(*(self.place[box][..., k] - foot[k] for k in range(2))) / r
            dark[box] = np.maximum(dark[box], np.clip((1.25 - off) / 0.5, 0, 1))
        grey *= 1 - (1 - _SHADOW) * dark

    def furnish(self, ax: Axes, co_moving: bool) -> None:
        """The axes of the picture: arrows along x, y, z, and what a square of the floor measures."""
        left, right, bottom, top = self.extent
        ax.set_xlim(left, right)
        ax.set_ylim(bottom, top)
        ax.set_aspect("equal")
        ax.set_xticks([])
        ax.set_yticks([])
        for spine in ax.spines.values():
            spine.set_visible(False)
        arm = 0.09 * min(right - left, 1.6 * (top - bottom))
        start = np.array([left + 1.25 * arm, bottom + 1.2 * arm])
        for name, colour, end in zip(
            "xyz", ("#c0392b", "#2e8b57", "#2456a6"), np.eye(3), strict=True
        ):
            tip = arm * (self.camera @ end)[:2]
            head = {
                "arrowstyle": "-|>",
                "color": colour,
                "linewidth": 1.4,
                "shrinkA": 0,
                "shrinkB": 0,
            }
            ax.annotate("", tuple(start + tip), tuple(start), arrowprops=head)
            size = max(float(np.hypot(*tip)), 1e-9)
            at = start + tip * (1 + 0.22 * arm / max(size, 0.3 * arm))
            ax.text(
                float(at[0]), float(at[1]), name, color=colour, ha="center", va="center", fontsize=9
            )
        moving = ", moving with the centre" if co_moving else ""
        if self.from_above:
            ax.set_xlabel(f"squares of {self.floor.square:g} $L${moving}", fontsize=9)
        else:
            ax.set_xlabel(f"$L$ is {1 / (right - left):.2g} of the width{moving}", fontsize=9)
