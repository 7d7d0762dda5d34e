"""What pictures share: the view, figures that fit what they show, colours."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Polygon

from .._checks import fail
from ..chain import Chain
from ..constraint import PrescribedPosition
from ..domain import AbstractDomain, AbstractHalfSpace, Unbounded
from ..force import Weight
from ..scene import Scene
from ..solution import Solution

_UNBOUNDED = Unbounded()
_CORNERS = ((-1, 0), (1, 0), (1, 1), (-1, 1))
_FIBRES = ("#2f6db3", "#e07b39", "#3d9a57", "#b8477d", "#8064c0", "#c49a1a", "#2fa3a3", "#777777")


def figure_for(axes: Axes | None, size: tuple[float, float]) -> tuple[Figure, Axes]:
    """The axes given and their figure, or new ones of a size [inches]."""
    if axes is not None:
        figure = axes.get_figure()
        if not isinstance(figure, Figure):
            fail("axes", "belong to a figure", "they do not")
        return figure, axes  # pyright: ignore[reportReturnType]
    figure = Figure(figsize=size, layout="constrained", dpi=150)
    return figure, figure.add_subplot()


@dataclass(frozen=True)
class View:
    """How positions become points of a picture.

    - `co_moving`: subtract the mean position at each time; in a half space only what is along its plane.
    - `plane`: the two coordinates shown; by default (0, 1) of a planar scene, while a spatial one is
      seen in space.
    - `stretch`: factor on the second one, to see small deflections (the axes then say so).
    - `domain`: that of the scene. Its plane is drawn if it is near; in a plane view if it is seen from
      the side, in space if it is seen from the fluid.
    - `azimuth`, `elevation`: of the camera in space [degrees], about the direction that is up and above
      the horizon. By default it looks from 20 degrees above, 25 degrees off the direction at right
      angles to where the beads are spread most.
    - `up`: direction that is up in space; by default away from the domain's plane, or z.

    >>> import jaxbeads as jb
    >>> from jaxbeads.plot import View
    >>> scene = jb.Scene(jb.Chain(1.0, 3), viscosity=1.0, domain=jb.NoSlipWall([0.0, 0.0], [0.0, 1.0]))
    >>> print(View.of(scene).domain is scene.domain, View(plane=(0, 2)).plane)
    True (0, 2)
    """

    co_moving: bool = False
    plane: tuple[int, int] | None = None
    stretch: float = 1.0
    domain: AbstractDomain = _UNBOUNDED
    azimuth: float | None = None
    elevation: float = 20.0
    up: Any = None

    @classmethod
    def of(cls, scene: Scene, **options: Any) -> "View":
        """A view of a scene: its domain, up against its weight, co-moving if there is no flow, no
        plane and no bead that is held. Other options as above.
        """
        held = any(isinstance(term, PrescribedPosition) for term in scene.constraints)
        still = held or scene.flow is not None or isinstance(scene.domain, AbstractHalfSpace)
        own: dict[str, Any] = {"domain": scene.domain, "co_moving": not still}
        for force in scene.forces:
            if isinstance(force, Weight):
                pull = np.reshape(np.asarray(force.force, float), (-1, force.force.shape[-1]))
                pull = pull.sum(axis=0)
                if len(pull) == 3 and np.any(pull):
                    own["up"] = tuple((-pull / np.linalg.norm(pull)).tolist())
        return cls(**{**own, **options})

    def spatial(self, solution: Solution) -> bool:
        """Whether a solution is seen in space."""
        return solution.states.position.shape[2] == 3 and self.plane is None

    @property
    def shown_axes(self) -> list[int]:
        """The coordinates of a plane view."""
        return list(self.plane or (0, 1))

    def positions(self, solution: Solution, length: float) -> np.ndarray:
        """All coordinates in units of `length`, shape `(times, beads, dim)`."""
        position = np.asarray(solution.states.position) / length
        if not self.co_moving:
            return position
        moved = position.mean(axis=1, keepdims=True)
        if (normal := self._normal) is not None:
            moved -= (moved @ normal)[..., None] * normal
        return position - moved

    @property
    def _normal(self) -> np.ndarray | None:
        """Of the domain's plane, if it has one."""
        if not isinstance(self.domain, AbstractHalfSpace):
            return None
        return np.asarray(self.domain.direction, float)

    def points(self, solution: Solution, length: float) -> np.ndarray:
        """Points in units of `length`, shape `(times, beads, 2)`."""
        position, (first, second) = self.positions(solution, length), self.shown_axes
        if max(first, second) >= position.shape[2] or first == second:
            fail("plane", f"name two of the {position.shape[2]} coordinates", f"it is {self.plane}")
        return position[:, :, [first, second]] * np.array([1.0, self.stretch])

    def label(self, ax: Axes) -> None:
        """Write what the axes are."""
        first, second = (self._moving(k) for k in self.shown_axes)
        factor = "" if self.stretch == 1 else rf"{self.stretch:g}\,"
        ax.set_xlabel(f"${first}/L$")
        ax.set_ylabel(f"${factor}{second}/L$")

    def _moving(self, axis: int) -> str:
        """Name of a coordinate, with that of the centre where it is subtracted."""
        name = "xyz"[axis]
        across = 0.0 if self._normal is None else abs(self._normal[axis])
        return f"({name} - {name}_c)" if self.co_moving and across < 1 - 1e-6 else name

    def wall(self, points: np.ndarray, length: float) -> tuple[np.ndarray, np.ndarray] | None:
        """A point of the domain's plane, in units of `length`, and its normal; `None` if it is further
        from points than all of them are wide.
        """
        if not isinstance(self.domain, AbstractHalfSpace):
            return None
        point = np.asarray(self.domain.point, float) / length
        normal = np.asarray(self.domain.direction, float)
        height = (points.reshape(-1, len(point)) - point) @ normal
        near = height.min() < np.ptp(points.reshape(-1, len(point)), axis=0).max()
        return (point, normal) if near else None

    def _boundary(self, length: float) -> tuple[np.ndarray, np.ndarray] | None:
        """A point of the domain's plane, in units of `length`, and its normal, as they are seen."""
        if not isinstance(self.domain, AbstractHalfSpace):
            return None
        point = np.asarray(self.domain.point)[self.shown_axes] / length
        normal = np.asarray(self.domain.direction)[self.shown_axes]
        return (point, normal) if np.linalg.norm(normal) > 1 - 1e-6 else None

    def shown(self, points: np.ndarray, length: float) -> np.ndarray:
        """What has to be in the picture, shape `(n, 2)`: the points, and the domain's plane below them
        unless it is further away than all of them are wide.
        """
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


WHOLE = View()


def check_chain(solution: Solution, chain: Chain) -> None:
    """Refuse a chain that is not the solution's."""
    beads = solution.states.position.shape[1]
    if chain.beads != beads:
        fail("chain", f"have the solution's {beads} beads", f"it has {chain.beads}")


def bead_colours(chain: Chain) -> np.ndarray:
    """A colour for each bead, `(beads, 3)`: from end to end of a single fibre, or each fibre's own."""
    if len(chain.fibres) == 1:
        return colormaps["viridis"](np.linspace(0, 0.9, chain.beads))[:, :3]
    own = np.array([[int(c[k : k + 2], 16) / 255 for k in (1, 3, 5)] for c in _FIBRES])
    return own[chain.fibre_of_bead % len(own)]


def fitted(
    low: np.ndarray, high: np.ndarray, width: float, least: float, most: float
) -> tuple[np.ndarray, np.ndarray, tuple[float, float]]:
    """Limits and the size [inches] of axes with a scale of one to one: `width` wide, less where they
    would be higher than `most`; limits are moved apart where a side would be shorter than `least`.
    """
    span = high - low
    scale = min(width / span[0], most / span[1])
    size = np.maximum(span * scale, least)
    grown, middle = size / scale / 2, (low + high) / 2
    return middle - grown, middle + grown, (float(size[0]), float(size[1]))
