"""The flow about beads on a plane."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PatchCollection
from matplotlib.figure import Figure
from matplotlib.patches import Circle

from .._checks import fail, whole
from ..chain import Chain
from ..fluid import AverageFlowField, FlowField, flow_field
from .base import View, figure_for


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

    >>> import jaxbeads as jb, jaxbeads.plot
    >>> scene = jb.Scene(jb.Chain(1.0, 3), viscosity=1.0, forces=[jb.force.Weight([0.0, -6.0])])
    >>> field = jb.flow_field(0.0, jb.straight(scene.chain, [1.0, 0.0]), scene)
    >>> figure = jaxbeads.plot.flow(field, scene.chain, number=10)
    >>> print(figure.axes[0].get_xlabel(), figure.axes[0].get_ylabel())
    $x/L$ $y/L$
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
    figure, ax = figure_for(axes, (5.4, float(np.clip(4.2 * shape, 1.5, 6.0)) + 0.5))
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
