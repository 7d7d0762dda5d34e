"""What a ready-made scene consists of."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from ..rollout import Solution
from ..scene import Scene
from ..simulate import simulate
from ..state import State


class Case(NamedTuple):
    """A scene with its start: everything that `simulate` needs."""

    scene: Scene
    state: State
    ts: np.ndarray
    """Times to save at [time]."""
    substeps: int | None = None
    """Equal steps between them; `None`: by eq. (39)."""
    until: Callable[[Solution], bool] | None = None
    """Ends the run early, as at a steady state."""
    chunk: int | None = None
    """Save times between two checks."""

    def simulate(self, **options: Any) -> Solution:
        """Run it with `jaxbeads.simulate`; options as there (they replace the case's own)."""
        own: dict[str, Any] = {"until": self.until, "chunk": self.chunk}
        if options.get("controller") is None:
            own["substeps"] = self.substeps
        return simulate(self.scene, self.state, self.ts, **{**own, **options})


@dataclass(frozen=True)
class ReadyMade:
    """A scene as the shell sees it.

    - `build`: function of the options that returns a `Case`; its defaults are the shell's.
    - `options`: name of each option and what it means.
    - `observables`: dimensionless results of a run.
    - `plotted`: name of an observable over time, and the function of a solution that gives it.
    - `stretch`: factor on the deflection in pictures.
    """

    name: str
    summary: str
    build: Callable[..., Case]
    options: dict[str, str]
    observables: Callable[[Case, Solution], dict[str, float]]
    plotted: tuple[str, Callable[[Case, Solution], Any]]
    stretch: float = 1.0
