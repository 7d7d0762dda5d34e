"""Shapes over time: centre lines in the plane, beads in space."""

from dataclasses import replace

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection
from matplotlib.colors import Normalize
from matplotlib.figure import Figure

from .._checks import whole
from ..chain import Chain
from ..solution import Solution
from .base import WHOLE, View, bead_colours, check_chain, figure_for, fitted
from .space import Stage

_BAR = 1.25  # width of the bar of colours [inches]


def _snapshots(points: np.ndarray, number: int) -> np.ndarray:
    """Times between which shape and place change equally much, so that fast events are seen."""
    if len(points) == 1:
        return np.zeros(1, int)
    shape = points - points.mean(axis=1, keepdims=True)
    change = np.full(len(points) - 1, 1e-3 / len(points))
    for moved in (shape, points):  # half by the shape, half by what is seen
        step = np.linalg.norm(np.diff(moved, axis=0), axis=2).mean(axis=1)
        change += step / max(step.sum(), 1e-300)
    path = np.concatenate([[0.0], np.cumsum(change)])
    return np.unique(np.searchsorted(path, np.linspace(0, path[-1] * (1 - 1e-12), number)))


def shapes(
    solution: Solution,
    chain: Chain,
    *,
    number: int | None = None,
    view: View = WHOLE,
    axes: Axes | None = None,
) -> Figure:
    """Shapes at `number` saved times (12, in space 6), coloured by time: centre lines in the plane, lit
    beads to scale in space, where of several fibres each has its colour and is pale at first.

    The times are such that shape and place change equally much from one to the next; the bar has a mark
    at each. In space a shape that would hide another is left out (for more of them: a larger `number`,
    more saved times, or a `view` that is not co-moving); if less than three are left in a co-moving view
    of beads that move by more than their thickness, the picture does not move with them.
    **Returns** a figure with equal axes in units of the first fibre's length L.

    **Raises** `ValueError` for a number below 1 and a chain that does not fit.

    >>> import jaxbeads as jb, jaxbeads.plot
    >>> scene = jb.Scene(jb.Chain(1.0, 3), viscosity=1.0, forces=[jb.force.Weight([0.0, -6.0])])
    >>> fall = jb.rollout(scene, jb.straight(scene.chain, [1.0, 0.0]), [0.0, 1.0, 2.0], substeps=1)
    >>> figure = jaxbeads.plot.shapes(fall, scene.chain, number=2)
    >>> print(figure.axes[0].get_xlabel(), figure.axes[0].get_ylabel())
    $x/L$ $y/L$
    """
    check_chain(solution, chain)
    if number is not None:
        whole("number", number, 1)
    length = float(chain.length[0])
    if view.spatial(solution):
        return _beads(solution, chain, number or 6, view, axes, length)
    points, ts = view.points(solution, length), np.asarray(solution.ts)
    scale, colours = Normalize(ts[0], ts[-1]), colormaps["viridis"]
    chosen = _snapshots(points, number or 12)
    shown = view.shown(points[chosen], length)
    low, high = shown.min(axis=0), shown.max(axis=0)
    margin = 0.04 * max(*(high - low), 1e-3)
    _, _, size = fitted(low - margin, high + margin, 4.8, 1.3, 4.8)
    figure, ax = figure_for(axes, (size[0] + 0.7 + _BAR, size[1] + 0.6))
    cuts = np.cumsum(chain.fibres)[:-1]
    for k in chosen:
        lines = np.split(points[k], cuts)
        ax.add_collection(LineCollection(lines, colors=[colours(scale(ts[k]))], linewidths=1.8))
    ax.update_datalim(shown)
    ax.autoscale_view()
    ax.set_aspect("equal", adjustable="datalim")
    view.draw_boundary(ax, length)
    view.label(ax)
    _bar(figure, ax, ScalarMappable(scale, colours), ts[chosen])
    return figure


def _bar(figure: Figure, ax: Axes, colours: ScalarMappable, times: np.ndarray) -> None:
    """A bar of colours with a mark at each of the times that are drawn."""
    bar = figure.colorbar(colours, ax=ax, label="time $t$")
    for t in times:
        bar.ax.axhline(float(t), color="white", linewidth=2.2)
        bar.ax.axhline(float(t), color="black", linewidth=1.0)


def _apart(points: np.ndarray, radii: np.ndarray, number: int) -> np.ndarray:
    """Times of which no shape is so near a later one that little of both is seen, as after a period."""
    kept: list[int] = []
    for k in _snapshots(points, number)[::-1]:
        off = np.linalg.norm(points[kept] - points[k], axis=-1).mean(axis=-1)
        if np.all(off > 0.5 * radii.mean()):
            kept.append(int(k))
    return np.array(kept[::-1])


def _beads(
    solution: Solution, chain: Chain, number: int, view: View, axes: Axes | None, length: float
) -> Figure:
    points, radii = view.positions(solution, length), np.asarray(chain.radii) / length
    chosen, ts = _apart(points, radii, number), np.asarray(solution.ts)
    if view.co_moving and len(chosen) < min(3, number):
        still = replace(view, co_moving=False)
        fixed = still.positions(solution, length)
        if np.ptp(fixed.mean(axis=1), axis=0).max() > 2 * radii.mean():
            view, points, chosen = still, fixed, _apart(fixed, radii, number)
    scale = Normalize(ts[0], ts[-1] if len(ts) > 1 else ts[0] + 1)
    stage = Stage(view, points[chosen], float(radii.max()), length)
    low, high, size = fitted(stage.low, stage.high, 6.0, 1.5, 5.5)
    stage.resize(low, high, round(150 * size[0]))
    shares = [float(scale(ts[k])) for k in chosen]
    if len(chain.fibres) == 1:
        bar = colormaps["viridis"]
        each = [np.tile(bar(share)[:3], (chain.beads, 1)) for share in shares]
    else:
        bar, own = colormaps["Greys"], bead_colours(chain)
        each = [own + (1 - own) * 0.7 * (shares[-1] - share) for share in shares]
    figure, ax = figure_for(axes, (size[0] + _BAR, size[1] + 0.4))
    picture = stage.paint(
        points[chosen].reshape(-1, 3), np.tile(radii, len(chosen)), np.concatenate(each)
    )
    ax.imshow(picture, extent=stage.extent, origin="lower")
    stage.furnish(ax, view.co_moving)
    _bar(figure, ax, ScalarMappable(scale, bar), ts[chosen])
    return figure
