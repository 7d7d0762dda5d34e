"""Pictures: shapes over time, an observable, a kymograph of curvature, the flow, a movie.

Each function takes a solution (or a flow) and returns a `matplotlib` figure, or writes a file. Lengths
are in units of the first fibre's length unless said. Imported on demand only (`import jaxbeads.plot`).
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection, PatchCollection
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Polygon
from matplotlib.ticker import MaxNLocator
from PIL import Image

from ._checks import fail, whole
from .chain import Chain
from .domain import AbstractDomain, AbstractHalfSpace, Unbounded
from .fluid import AverageFlowField, FlowField, flow_field
from .observables import curvature
from .solution import Solution


def _figure(axes: Axes | None, size: tuple[float, float]) -> tuple[Figure, Axes]:
    if axes is not None:
        figure = axes.get_figure()
        if not isinstance(figure, Figure):
            fail("axes", "belong to a figure", "they do not")
        return figure, axes  # pyright: ignore[reportReturnType]
    figure = Figure(figsize=size, layout="constrained", dpi=150)
    return figure, figure.add_subplot()


_UNBOUNDED = Unbounded()
_CORNERS = ((-1, 0), (1, 0), (1, 1), (-1, 1))


@dataclass(frozen=True)
class View:
    """How positions become points of a picture.

    - `co_moving`: subtract the mean position at each time.
    - `plane`: the two coordinates shown.
    - `stretch`: factor on the second one, to see small deflections (the axes then say so).
    - `domain`: that of the scene. Its plane is drawn if it is seen from the side and does not move.
    """

    co_moving: bool = False
    plane: tuple[int, int] = (0, 1)
    stretch: float = 1.0
    domain: AbstractDomain = _UNBOUNDED

    def points(self, solution: Solution, length: float) -> np.ndarray:
        """Points in units of `length`, shape `(times, beads, 2)`."""
        position = np.asarray(solution.states.position) / length
        if max(self.plane) >= position.shape[2] or self.plane[0] == self.plane[1]:
            fail("plane", f"name two of the {position.shape[2]} coordinates", f"it is {self.plane}")
        if self.co_moving:
            position = position - position.mean(axis=1, keepdims=True)
        return position[:, :, list(self.plane)] * np.array([1.0, self.stretch])

    def label(self, ax: Axes) -> None:
        """Write what the axes are."""
        first, second = ("xyz"[k] for k in self.plane)
        if self.co_moving:
            first, second = f"({first} - {first}_c)", f"({second} - {second}_c)"
        factor = "" if self.stretch == 1 else rf"{self.stretch:g}\,"
        ax.set_xlabel(f"${first}/L$")
        ax.set_ylabel(f"${factor}{second}/L$")

    def _boundary(self, length: float) -> tuple[np.ndarray, np.ndarray] | None:
        """A point of the domain's plane, in units of `length`, and its normal, as they are seen."""
        if self.co_moving or not isinstance(self.domain, AbstractHalfSpace):
            return None
        seen = list(self.plane)
        point = np.asarray(self.domain.point)[seen] / length
        normal = np.asarray(self.domain.direction)[seen]
        return (point, normal) if np.linalg.norm(normal) > 1 - 1e-6 else None

    def shown(self, points: np.ndarray, length: float) -> np.ndarray:
        """What has to be in the picture, shape `(n, 2)`: the points, and the domain's plane below them
        unless it is further away than all of them are wide."""
        points, plane = points.reshape(-1, 2), self._boundary(length)
        if plane is None:
            return points
        (point, normal), scale = plane, np.array([1.0, self.stretch])
        height = ((points / scale - point) @ normal)[:, None]
        near = height.min() < np.ptp(points / scale, axis=0).max()
        return np.concatenate([points, points - height * normal * scale]) if near else points

    def draw_boundary(self, ax: Axes, length: float) -> None:
        """Draw what is behind the domain's plane; the limits of the axes stay."""
        plane = self._boundary(length)
        if plane is None:
            return
        (point, normal), scale = plane, np.array([1.0, self.stretch])
        far = 10 * sum(np.abs(limit).max() for limit in (ax.get_xlim(), ax.get_ylim(), point))
        along = np.array([normal[1], -normal[0]])
        corners = [point + far * (k * along - m * normal) for k, m in _CORNERS]
        wall = Polygon(np.array(corners) * scale, facecolor="0.85", edgecolor="0.3", zorder=0)
        ax.add_artist(wall)


_WHOLE = View()


def _check(solution: Solution, chain: Chain) -> None:
    beads = solution.states.position.shape[1]
    if chain.beads != beads:
        fail("chain", f"have the solution's {beads} beads", f"it has {chain.beads}")


def _snapshots(points: np.ndarray, number: int) -> np.ndarray:
    """Times between which the shape changes equally much, so that fast events are seen."""
    if len(points) == 1:
        return np.zeros(1, int)
    shape = points - points.mean(axis=1, keepdims=True)
    change = np.linalg.norm(np.diff(shape, axis=0), axis=2).mean(axis=1)
    path = np.concatenate([[0.0], np.cumsum(change + 1e-3 * change.mean() + 1e-300)])
    return np.unique(np.searchsorted(path, np.linspace(0, path[-1] * (1 - 1e-12), number)))


def shapes(
    solution: Solution,
    chain: Chain,
    *,
    number: int = 12,
    view: View = _WHOLE,
    axes: Axes | None = None,
) -> Figure:
    """Centre lines at `number` saved times, coloured by time.

    The times are such that the shape changes equally much from one to the next. **Returns** a figure
    with equal axes in units of the first fibre's length L.
    """
    _check(solution, chain)
    whole("number", number, 1)
    length = float(chain.length[0])
    points, ts = view.points(solution, length), np.asarray(solution.ts)
    scale, colours = Normalize(ts[0], ts[-1]), colormaps["viridis"]
    figure, ax = _figure(axes, (5.0, 4.0))
    cuts = np.cumsum(chain.fibres)[:-1]
    chosen = _snapshots(points, number)
    for k in chosen:
        lines = np.split(points[k], cuts)
        ax.add_collection(LineCollection(lines, colors=[colours(scale(ts[k]))], linewidths=1.8))
    ax.update_datalim(view.shown(points[chosen], length))
    ax.autoscale_view()
    ax.set_aspect("equal", adjustable="datalim")
    view.draw_boundary(ax, length)
    view.label(ax)
    figure.colorbar(ScalarMappable(scale, colours), ax=ax, label="time $t$")
    return figure


def observable(
    ts: Any, values: Any, label: str, *, time_label: str = "time $t$", axes: Axes | None = None
) -> Figure:
    """A quantity over time. **Returns** a figure."""
    figure, ax = _figure(axes, (5.0, 3.2))
    ax.plot(np.asarray(ts), np.asarray(values), color="#31688e", linewidth=1.6)
    ax.xaxis.set_major_locator(MaxNLocator(6))
    ax.set_xlabel(time_label)
    ax.set_ylabel(label)
    ax.grid(alpha=0.3)
    return figure


def kymograph(solution: Solution, chain: Chain, *, axes: Axes | None = None) -> Figure:
    """Curvature times length along the (first) fibre, over time.

    Signed in the plane, where red bends anticlockwise from the first bead to the last.
    **Returns** a figure. **Raises** `ValueError` for fewer than three beads.
    """
    _check(solution, chain)
    beads = chain.fibres[0]
    if beads < 3:
        fail("chain", "have at least three beads in its first fibre", f"it has {beads}")
    length, ts = float(chain.length[0]), np.asarray(solution.ts)
    values = np.asarray(curvature(solution.states.position, chain))[:, : beads - 2] * length
    planar = solution.states.position.shape[2] == 2
    most = max(float(np.max(np.abs(values))), 1e-6)  # rounding is not worth a colour
    figure, ax = _figure(axes, (5.0, 3.6))
    arclength = np.arange(0.5, beads - 1) / (beads - 1)
    image = ax.pcolormesh(
        ts,
        (arclength[1:] + arclength[:-1]) / 2,
        values.T,
        cmap="RdBu_r" if planar else "viridis",
        vmin=-most if planar else 0.0,
        vmax=most,
        shading="nearest",
        rasterized=True,
    )
    ax.xaxis.set_major_locator(MaxNLocator(6))
    ax.set_xlabel("time $t$")
    ax.set_ylabel("arclength $s/L$")
    figure.colorbar(image, ax=ax, label=r"curvature $\kappa L$")
    return figure


def flow(
    field: FlowField | AverageFlowField,
    chain: Chain,
    *,
    plane: tuple[int, int] = (0, 1),
    level: float | None = None,
    margin: float = 0.5,
    number: int = 120,
    axes: Axes | None = None,
) -> Figure:
    """Streamlines and speed of the fluid on a plane, with the beads that it cuts (those in front of it
    and behind it as circles). A streamline follows the components in the plane, the colour is the
    speed of all three.

    **Arguments**

    - `field`: from `flow_field`, or `average_flow_field` (with the outlines of the beads at first);
      co-moving if the field is.
    - `chain`: the beads.
    - `plane`: the two coordinates shown; `level`: the third one's value over L, by default the beads'
      mean.
    - `margin`: by how much the picture is larger than the beads, over L; `number`: of points along
      its longer side.

    **Returns** a figure, with equal axes in units of the first fibre's length L. **Raises** `ValueError`
    for a plane that is none.
    """
    whole("number", number, 8)
    if len(set(plane)) != 2 or not set(plane) <= {0, 1, 2}:
        fail("plane", "name two of the 3 coordinates", f"it is {plane}")
    position, radii, clearance = _beads_of(field)
    if len(position) != chain.beads:
        fail("chain", f"have the field's {len(position)} beads", f"it has {chain.beads}")
    length, axis = float(chain.length[0]), 3 - sum(plane)
    position, radii = position / length, radii / length
    level = float(position[:, axis].mean()) if level is None else level
    centres = position[:, list(plane)]
    low = (centres - radii[:, None]).min(axis=0) - margin
    high = (centres + radii[:, None]).max(axis=0) + margin
    step = (high - low).max() / (number - 1)
    x, y = (np.linspace(a, b, round((b - a) / step) + 1) for a, b in zip(low, high, strict=True))
    points = np.empty((len(y), len(x), 3))
    points[..., plane[0]], points[..., plane[1]] = np.meshgrid(x, y)
    points[..., axis] = level
    velocity = np.array(field(points * length))
    velocity[~clearance(points * length)] = np.nan  # beyond a wall
    speed = np.linalg.norm(velocity, axis=-1)
    shape = (high - low)[1] / (high - low)[0]
    figure, ax = _figure(axes, (5.4, float(np.clip(4.2 * shape, 1.5, 6.0)) + 0.5))
    ax.set_facecolor("0.8")
    image = ax.pcolormesh(x, y, speed, cmap="viridis", vmin=0.0, shading="gouraud", rasterized=True)
    u, v = velocity[..., plane[0]], velocity[..., plane[1]]
    if np.nanmax(np.hypot(u, v)) > 0:
        ax.streamplot(x, y, u, v, density=1.3, color="white", linewidth=0.6, arrowsize=0.7)
    whole_time = isinstance(field, AverageFlowField)  # then the beads are not there all the time
    _draw_cut(ax, centres, radii, np.inf if whole_time else position[:, axis] - level)
    ax.set_xlim(low[0], high[0])
    ax.set_ylim(low[1], high[1])
    ax.set_aspect("equal")
    View(field.co_moving, plane).label(ax)
    figure.colorbar(image, ax=ax, label="speed $|u|$")
    return figure


def _beads_of(
    field: FlowField | AverageFlowField,
) -> tuple[np.ndarray, np.ndarray, Callable[[np.ndarray], np.ndarray]]:
    """Centres and radii of the beads in the field's frame, and whether there is fluid at points."""
    if isinstance(field, AverageFlowField):
        first = jax.tree.map(lambda x: x[0], field.solution.states)
        field = flow_field(field.solution.ts[0], first, field.scene, co_moving=field.co_moving)
    spheres = field.configuration
    position = np.asarray(spheres.position)
    centre = position.mean(axis=0) if field.co_moving else np.zeros(3)

    def fluid(points: np.ndarray) -> np.ndarray:
        flat = jnp.asarray((points + centre).reshape(-1, 3), spheres.position.dtype)
        clearance = spheres.domain.clearance(flat, jnp.zeros((), flat.dtype))
        there = np.ones(len(flat), bool) if clearance is None else np.asarray(clearance) >= 0
        return there.reshape(points.shape[:-1])

    return position - centre, np.broadcast_to(spheres.radius, len(position)), fluid


def _draw_cut(ax: Axes, centres: np.ndarray, radii: np.ndarray, height: np.ndarray | float) -> None:
    """Beads cut by a plane as discs, their outlines as circles; `height`: of the centres above it."""
    cut = np.sqrt(np.maximum(radii**2 - height**2, 0.0))
    rings = [Circle(tuple(c), r) for c, r in zip(centres, radii, strict=True)]
    discs = [Circle(tuple(c), r) for c, r in zip(centres, cut, strict=True) if r > 0]
    style = {"edgecolors": "black", "linewidths": 0.5, "zorder": 3}
    ax.add_collection(PatchCollection(rings, facecolors="none", **style))
    ax.add_collection(PatchCollection(discs, facecolors="#e8e4d8", **style))


def movie(
    solution: Solution,
    chain: Chain,
    path: str | Path,
    *,
    frames: int = 90,
    seconds: float = 6.0,
    view: View = _WHOLE,
) -> Path:
    """Write an animated gif of the beads, drawn to scale.

    **Arguments**: number of `frames`, spread evenly over the saved times; duration in `seconds`.
    **Returns** the path. **Raises** `ValueError` if it is no gif or cannot be written.
    """
    path = Path(path)
    if path.suffix.lower() != ".gif":
        fail("path", "end in .gif", f"it is {path}")
    _check(solution, chain)
    whole("frames", frames, 1)
    length = float(chain.length[0])
    points, radii = view.points(solution, length), np.asarray(chain.radii) / length
    ts = np.asarray(solution.ts)
    chosen = np.unique(np.linspace(0, len(ts) - 1, frames).round().astype(int))
    margin = 0.05 + float(radii.max())  # beads of a short fibre are large
    shown = view.shown(points, length)
    low, high = shown.min(axis=0) - margin, shown.max(axis=0) + margin
    width, height = high - low
    figure = Figure(figsize=(5.0, float(np.clip(5 * height / width, 1.5, 6.0)) + 0.6), dpi=90)
    ax = figure.add_axes((0.13, 0.12, 0.84, 0.8))
    colours = colormaps["viridis"](np.linspace(0, 0.9, len(radii)))
    images = []
    for k in chosen:
        ax.clear()
        ax.set_xlim(low[0], high[0])
        ax.set_ylim(low[1], high[1])
        ax.set_aspect("equal")
        view.draw_boundary(ax, length)
        view.label(ax)
        ax.set_title(f"t = {ts[k]:.4g}", fontsize=9)
        beads = [Circle(tuple(p), r) for p, r in zip(points[k], radii, strict=True)]
        ax.add_collection(PatchCollection(beads, facecolors=colours, edgecolors="none"))
        images.append(_raster(figure))
    try:
        images[0].save(
            path,
            save_all=True,
            append_images=images[1:],
            duration=max(20, int(1000 * seconds / len(images))),
            loop=0,
        )
    except OSError as error:
        fail("path", "be a file that can be written", f"{path} is not: {error.strerror}")
    return path


def _raster(figure: Figure) -> Image.Image:
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    pixels = Image.fromarray(np.asarray(canvas.buffer_rgba()))
    return pixels.convert("P", palette=Image.Palette.ADAPTIVE)
