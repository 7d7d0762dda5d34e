"""A page to turn, zoom and play: one file that holds all it needs, by `k3d` (the extra `view`)."""

from pathlib import Path
from typing import Any

import numpy as np

from .._checks import fail, whole
from ..chain import Chain
from ..solution import Solution
from .base import WHOLE, View, bead_colours, check_chain
from .space import Stage


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
    browser and no network. Times run from 0 to `seconds`; a single state stands still.

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
    page = maker.plot(name=path.stem, camera_auto_fit=False, time_speed=1.0)
    page += maker.points(shown, point_sizes=sizes, colors=colours, shader="3d")
    if position.shape[2] == 3:
        right, up, viewer = Stage(view, lifted[chosen], float(radii.max()), length).camera
    else:
        right, up, viewer = np.eye(3)
    middle = (lifted[chosen].min(axis=(0, 1)) + lifted[chosen].max(axis=(0, 1))) / 2
    width = max(float(np.ptp(lifted[chosen].reshape(-1, 3) @ right)), 2 * float(radii.max()))
    page.camera = [*(middle + 1.3 * width * viewer).tolist(), *middle.tolist(), *up.tolist()]
    try:
        path.write_text(page.get_snapshot(), encoding="utf-8")
    except OSError as error:
        fail("path", "be a file that can be written", f"{path} is not: {error.strerror}")
    return path
