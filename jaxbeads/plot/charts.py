"""Curves and maps: an observable over time, a kymograph of curvature."""

from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from .._checks import fail
from ..chain import Chain
from ..observables import curvature
from ..solution import Solution
from .base import check_chain, figure_for


def observable(
    ts: Any, values: Any, label: str, *, time_label: str = "time $t$", axes: Axes | None = None
) -> Figure:
    """A quantity over time, shape `(times,)`, or several, `(times, columns)`: each has its colour, told
    by a legend, or by a bar if there are more than ten. **Returns** a figure. **Raises** `ValueError`
    for values of another shape.

    >>> import jaxbeads.plot
    >>> figure = jaxbeads.plot.observable([0.0, 1.0, 2.0], [0.0, 1.0, 4.0], "distance $d/L$")
    >>> print(figure.axes[0].get_xlabel(), figure.axes[0].get_ylabel())
    time $t$ distance $d/L$
    """
    ts, values = np.asarray(ts), np.asarray(values)
    if values.ndim not in (1, 2) or len(values) != len(ts):
        must = f"have the shape (times,) or (times, columns) with {len(ts)} times"
        fail("values", must, f"it is {values.shape}")
    figure, ax = figure_for(axes, (5.0, 3.2))
    if values.ndim == 1 or values.shape[1] == 1:
        ax.plot(ts, values, color="#31688e", linewidth=1.6)
    else:
        columns = values.shape[1]
        scale, colours = Normalize(0, columns / 0.9 - 1), colormaps["viridis"]  # less pale yellow
        for k in range(columns):
            ax.plot(ts, values[:, k], color=colours(scale(k)), linewidth=1.6, label=f"{k}")
        if columns <= 10:
            ax.legend(title="column", fontsize=8, title_fontsize=8, ncols=1 + columns // 6)
        else:
            bar = figure.colorbar(ScalarMappable(scale, colours), ax=ax, label="column")
            bar.ax.set_ylim(0, columns - 1)
    ax.xaxis.set_major_locator(MaxNLocator(6))
    ax.set_xlabel(time_label)
    ax.set_ylabel(label)
    ax.grid(alpha=0.3)
    return figure


def kymograph(solution: Solution, chain: Chain, *, axes: Axes | None = None) -> Figure:
    """Curvature times length along the (first) fibre, over time.

    Signed in the plane, where red bends anticlockwise from the first bead to the last.
    **Returns** a figure. **Raises** `ValueError` for fewer than three beads.

    >>> import jaxbeads as jb, jaxbeads.plot
    >>> scene = jb.Scene(jb.Chain(1.0, 3), viscosity=1.0, forces=[jb.force.Weight([0.0, -6.0])])
    >>> fall = jb.rollout(scene, jb.straight(scene.chain, [1.0, 0.0]), [0.0, 1.0, 2.0], substeps=1)
    >>> figure = jaxbeads.plot.kymograph(fall, scene.chain)
    >>> print(figure.axes[0].get_xlabel(), figure.axes[0].get_ylabel())
    time $t$ arclength $s/L$
    """
    check_chain(solution, chain)
    beads = chain.fibres[0]
    if beads < 3:
        fail("chain", "have at least three beads in its first fibre", f"it has {beads}")
    length, ts = float(chain.length[0]), np.asarray(solution.ts)
    values = np.asarray(curvature(solution.states.position, chain))[:, : beads - 2] * length
    planar = solution.states.position.shape[2] == 2
    most = max(float(np.max(np.abs(values))), 1e-6)  # rounding is not worth a colour
    figure, ax = figure_for(axes, (5.0, 3.6))
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
