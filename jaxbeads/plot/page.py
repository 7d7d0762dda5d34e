"""A page to turn, zoom and play: one file that holds all it needs, by `k3d` (the extra `view`)."""

from pathlib import Path
from typing import Any

import numpy as np

from .._checks import fail, whole
from ..chain import Chain
from ..solution import Solution
from .base import WHOLE, View, bead_colours, check_chain
from .space import Stage

_FIELD, _ASPECT, _FILLED = (
    60.0,
    1.2,
    0.88,
)  # vertical field of view [degrees]; width over height; share
_FOLD = "if (K3DInstance.gui) K3DInstance.gui.close();"


def html(
    solution: Solution,
    chain: Chain,
    path: str | Path,
    *,
    frames: int = 90,
    seconds: float = 6.0,
    view: View = WHOLE,
) -> Path:
    """Write a page in which the beads, as spheres to scale, can be turned, zoomed and played. It needs a
    browser and no network. Times run from 0 to `seconds`; a single state stands still. To play, unfold
    the panel: Controls, Animation.

    All beads at all times are in sight as the page opens, in a window that is wider than high. The
    domain's plane is a half transparent square, if the view has it, it is near and does not move.

    **Arguments**: as for `movie`. A planar solution lies in the plane z = 0.
    **Returns** the path. **Raises** `ValueError` if it does not end in .html or cannot be written, and
    without `k3d`.

    >>> import jaxbeads as jb, jaxbeads.plot
    >>> scene = jb.Scene(jb.Chain(1.0, 3), viscosity=1.0, forces=[jb.force.Weight([0.0, -6.0])])
    >>> fall = jb.rollout(scene, jb.straight(scene.chain, [1.0, 0.0]), [0.0, 1.0, 2.0], substeps=1)
    >>> print(jaxbeads.plot.html(fall, scene.chain, "fall.html", frames=2))
    fall.html
    """
    path = Path(path)
    if path.suffix.lower() != ".html":
        fail("path", "end in .html", f"it is {path}")
    check_chain(solution, chain)
    whole("frames", frames, 1)
    try:
        import k3d  # pyright: ignore[reportMissingImports]
    except ImportError:
        raise ValueError(
            "`jaxbeads.plot.html` needs the package k3d, which is not installed: install the extra "
            "`view`."
        ) from None
    length = float(chain.length[0])
    position, radii = view.positions(solution, length), np.asarray(chain.radii) / length
    lifted = np.zeros((*position.shape[:2], 3), np.float32)
    lifted[..., : position.shape[2]] = position
    chosen = np.unique(np.linspace(0, len(position) - 1, frames).round().astype(int))
    colours: Any = (255 * bead_colours(chain)).round().astype(np.uint32) @ np.array(
        [65536, 256, 1], np.uint32
    )
    shown: Any = lifted[chosen[0]]
    if len(chosen) > 1:
        at = np.linspace(0.0, seconds, len(chosen))
        shown = {f"{t:.4f}": lifted[k] for t, k in zip(at, chosen, strict=True)}
    sizes: Any = (2 * radii).astype(np.float32)
    maker: Any = k3d  # whose `plot` is a function beside a module of that name
    page = maker.plot(
        name=path.stem, camera_auto_fit=False, camera_fov=_FIELD, grid_visible=False, time_speed=1.0
    )
    page += maker.points(shown, point_sizes=sizes, colors=colours, shader="3d")
    # k3d draws as deep as what is there at first: two points, as good as unseen, reach about all.
    far = float(radii.max())
    ends: Any = np.stack(
        [lifted[chosen].min(axis=(0, 1)) - far, lifted[chosen].max(axis=(0, 1)) + far]
    )
    page += maker.points(ends, point_size=1e-3 * far, color=0xFFFFFF, shader="flat")
    wall = view.wall(position[chosen], length)
    if wall is not None:
        square = _square(lifted[chosen].reshape(-1, 3), float(radii.max()), *wall)
        triangles = np.array([[0, 1, 2], [0, 2, 3]], np.uint32)
        page += maker.mesh(square, triangles, color=0xB0B0B0, opacity=0.5, side="double")
    axes = np.eye(3)
    if position.shape[2] == 3:
        axes = Stage(view, lifted[chosen], float(radii.max()), length).camera
    page.camera = _camera(lifted[chosen].astype(float), radii, axes)
    try:
        path.write_text(page.get_snapshot(additional_js_code=_FOLD), encoding="utf-8")
    except OSError as error:
        fail("path", "be a file that can be written", f"{path} is not: {error.strerror}")
    return path


def _camera(points: np.ndarray, radii: np.ndarray, axes: np.ndarray) -> list[float]:
    """Where a camera is, what it looks at and what is up for it, so that it sees all spheres at points
    `(times, beads, 3)`; `axes`: its directions to the right, up and to the viewer, as rows.
    """
    seen = points @ axes.T
    middle = (seen.min(axis=(0, 1)) + seen.max(axis=(0, 1))) / 2
    off = seen - middle
    # A sphere is inside a side of the field, a plane through the camera, if it is its radius off.
    half = _FILLED * np.tan(np.radians(_FIELD / 2)) * np.array([_ASPECT, 1.0])
    sine, cosine = half / np.sqrt(1 + half**2), 1 / np.sqrt(1 + half**2)
    away = off[..., 2:] + (np.abs(off[..., :2]) * cosine + radii[:, None]) / sine
    place = middle + np.array([0.0, 0.0, away.max()])
    return [*(place @ axes).tolist(), *(middle @ axes).tolist(), *axes[1].tolist()]


def _square(points: np.ndarray, radius: float, at: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Corners `(4, 3)` of a square in a plane, about what is below points `(n, 3)`."""
    lift = np.zeros((2, 3))
    lift[:, : len(at)] = at, normal / np.linalg.norm(normal)
    at, normal = lift
    middle = (points.min(axis=0) + points.max(axis=0)) / 2
    side = 0.75 * float(np.ptp(points, axis=0).max()) + 3 * radius
    along, across = side * np.linalg.svd(normal[None])[2][1:]
    foot = middle - ((middle - at) @ normal) * normal
    corners = [foot + k * along + m * across for k, m in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
    return np.array(corners, np.float32)
