"""Movies: beads drawn to scale, in the plane or in space, as gif or mp4."""

import io
import subprocess
from collections.abc import Iterator, Sequence
from importlib.util import find_spec
from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import PatchCollection
from matplotlib.figure import Figure
from matplotlib.patches import Circle
from PIL import Image

from .._checks import fail, whole
from ..chain import Chain
from ..solution import Solution
from .base import WHOLE, View, bead_colours, check_chain, fitted
from .space import Stage

_DPI, _WIDTH, _HEIGHT = 100, 8.85, 6.5  # of what is drawn [inches]
_SHARP = Image.Dither.NONE
_MOST = 2_000_000  # bytes of a gif that a talk or a page likes


def can_encode() -> bool:
    """Whether mp4 can be written: `imageio-ffmpeg` is installed.

    >>> import jaxbeads.plot
    >>> print(jaxbeads.plot.can_encode() in (True, False))
    True
    """
    try:
        return find_spec("imageio_ffmpeg") is not None
    except ValueError:  # it is there and has no place
        return False


def movie(
    solution: Solution,
    chain: Chain,
    path: str | Path,
    *,
    frames: int = 90,
    seconds: float = 6.0,
    view: View = WHOLE,
) -> Path:
    """Write a movie of the beads, drawn to scale, about 1000 points wide: an animated gif, or mp4 with
    the extra `movie`. A spatial solution is seen in space.

    **Arguments**: number of `frames`, spread evenly over the saved times; duration in `seconds`.
    **Returns** the path. **Raises** `ValueError` if it is neither .gif nor .mp4 or cannot be written.

    >>> import jaxbeads as jb, jaxbeads.plot
    >>> scene = jb.Scene(jb.Chain(1.0, 3), viscosity=1.0, forces=[jb.force.Weight([0.0, -6.0])])
    >>> fall = jb.rollout(scene, jb.straight(scene.chain, [1.0, 0.0]), [0.0, 1.0, 2.0], substeps=1)
    >>> print(jaxbeads.plot.movie(fall, scene.chain, "fall.gif", frames=2, seconds=1.0))
    fall.gif
    """
    return movies(solution, chain, [path], frames=frames, seconds=seconds, view=view)[0]


def movies(
    solution: Solution,
    chain: Chain,
    paths: Sequence[str | Path],
    *,
    frames: int = 90,
    seconds: float = 6.0,
    view: View = WHOLE,
) -> list[Path]:
    """The same movie in several files, as a gif and an mp4. Arguments as for `movie`.

    **Returns** the paths. **Raises** as `movie`.

    >>> import jaxbeads as jb, jaxbeads.plot
    >>> scene = jb.Scene(jb.Chain(1.0, 3), viscosity=1.0, forces=[jb.force.Weight([0.0, -6.0])])
    >>> fall = jb.rollout(scene, jb.straight(scene.chain, [1.0, 0.0]), [0.0, 1.0, 2.0], substeps=1)
    >>> for path in jaxbeads.plot.movies(fall, scene.chain, ["one.gif", "two.gif"], frames=2):
    ...     print(path)
    one.gif
    two.gif
    """
    files = [Path(path) for path in paths]
    for path in files:
        if path.suffix.lower() not in (".gif", ".mp4"):
            fail("path", "end in .gif or .mp4", f"it is {path}")
        if path.suffix.lower() == ".mp4" and not can_encode():
            must = "end in .gif where imageio-ffmpeg is not installed (the extra `movie`)"
            fail("path", must, f"it is {path}")
    check_chain(solution, chain)
    whole("frames", frames, 1)
    ts = np.asarray(solution.ts)
    chosen = np.unique(np.linspace(0, len(ts) - 1, frames).round().astype(int))
    drawn = _in_space if view.spatial(solution) else _in_plane
    pictures = list(drawn(solution, chain, chosen, view))
    for path in files:
        try:
            if path.suffix.lower() == ".gif":
                path.write_bytes(_gif(pictures, max(20, int(1000 * seconds / len(pictures)))))
            else:
                _mp4(pictures, path, len(pictures) / seconds)
        except OSError as error:
            fail("path", "be a file that can be written", f"{path} is not: {error.strerror}")
    return files


def _canvas(
    size: tuple[float, float], margins: tuple[float, float, float, float]
) -> tuple[Figure, FigureCanvasAgg, tuple[float, float, float, float]]:
    """A figure about axes of a size, with margins left, right, bottom, top [inches]; where they are."""
    left, right, bottom, top = margins
    # In whole and even numbers of points, which video wants.
    width, height = (
        2 * np.ceil(_DPI * x / 2) / _DPI for x in (size[0] + left + right, size[1] + bottom + top)
    )
    figure = Figure(figsize=(width, height), dpi=_DPI)
    where = (left / width, bottom / height, size[0] / width, size[1] / height)
    return figure, FigureCanvasAgg(figure), where


def _pixels(canvas: FigureCanvasAgg) -> Image.Image:
    canvas.draw()
    return Image.fromarray(np.asarray(canvas.buffer_rgba())).convert("RGB")


def _in_plane(
    solution: Solution, chain: Chain, chosen: np.ndarray, view: View
) -> Iterator[Image.Image]:
    length = float(chain.length[0])
    points, radii = view.points(solution, length), np.asarray(chain.radii) / length
    margin = 0.02 + float(radii.max())  # beads of a short fibre are large
    shown = view.shown(points[chosen], length)
    low, high = shown.min(axis=0) - margin, shown.max(axis=0) + margin
    low, high, size = fitted(low, high, _WIDTH, 1.5, _HEIGHT)
    figure, canvas, where = _canvas(size, (0.95, 0.2, 0.65, 0.4))
    ax = figure.add_axes(where)
    colours = bead_colours(chain)
    ax.set_xlim(low[0], high[0])
    ax.set_ylim(low[1], high[1])
    ax.tick_params(labelsize=12)
    view.draw_boundary(ax, length)
    view.label(ax)
    for label in (ax.xaxis.label, ax.yaxis.label):
        label.set_fontsize(14)
    drawn = None
    for k in chosen:
        if drawn is not None:
            drawn.remove()
        ax.set_title(f"t = {float(solution.ts[k]):.4g}", fontsize=13)
        beads = [Circle(tuple(p), r) for p, r in zip(points[k], radii, strict=True)]
        drawn = ax.add_collection(PatchCollection(beads, facecolors=colours, edgecolors="none"))
        yield _pixels(canvas)


def _in_space(
    solution: Solution, chain: Chain, chosen: np.ndarray, view: View
) -> Iterator[Image.Image]:
    length = float(chain.length[0])
    points, radii = view.positions(solution, length), np.asarray(chain.radii) / length
    stage = Stage(view, points[chosen], float(radii.max()), length)
    low, high, size = fitted(stage.low, stage.high, _WIDTH + 0.95, 2.0, _HEIGHT + 0.4)
    stage.resize(low, high, round(_DPI * size[0]))
    figure, canvas, where = _canvas(size, (0.1, 0.1, 0.45, 0.4))
    ax = figure.add_axes(where)
    colours = bead_colours(chain)
    image = None
    for k in chosen:
        picture = stage.paint(points[k], radii, colours)
        if image is None:
            image = ax.imshow(picture, extent=stage.extent, origin="lower", interpolation="none")
            stage.furnish(ax, view.co_moving)
            ax.xaxis.label.set_fontsize(12)
        image.set_data(picture)
        ax.set_title(f"t = {float(solution.ts[k]):.4g}", fontsize=13)
        yield _pixels(canvas)


def _gif(pictures: list[Image.Image], duration: int) -> bytes:
    """An animated gif; with fewer colours, and then fewer points, where it would be large."""
    for colours, part in ((256, 1.0), (128, 1.0), (64, 1.0), (48, 0.9), (32, 0.8), (32, 0.6)):
        size = tuple(round(part * n) for n in pictures[0].size)
        scaled = pictures if part == 1 else [p.resize(size) for p in pictures]  # pyright: ignore
        palette = _palette(scaled[:: max(1, len(scaled) // 4)], colours)
        first, *rest = (p.quantize(palette=palette, dither=_SHARP) for p in scaled)
        file = io.BytesIO()
        first.save(file, "gif", save_all=True, append_images=rest, duration=duration, loop=0)
        if len(file.getvalue()) < _MOST:
            break
    return file.getvalue()


# Letters, shadows, lines, walls, floors, paper: with a gap below white, or PIL takes what is beside it.
_GREYS = (0, 40, 80, 120, 150, 165, 176, 188, 200, 210, 219, 230, 243, 255)


def _palette(pictures: list[Image.Image], colours: int) -> Image.Image:
    """One palette for all, so that what does not change from one to the next costs nothing. Each shade
    counts alike, or paper and floor would take most of them.
    """
    every = np.concatenate([np.asarray(p).reshape(-1, 3) for p in pictures])
    every = every[np.ptp(every, axis=1) > 12]
    palette = [shade for grey in _GREYS for shade in 3 * (grey,)]
    if len(every):
        _, first = np.unique((every >> 3) @ np.array([1, 32, 1024]), return_index=True)
        shades = Image.fromarray(every[first][None])
        number = min(colours - len(_GREYS), len(first))
        few = shades.quantize(number, Image.Quantize.MEDIANCUT, kmeans=2, dither=_SHARP)
        palette += (few.getpalette() or [])[: 3 * number]
    image = Image.new("P", (1, 1))
    image.putpalette(palette)
    return image


def _mp4(pictures: list[Image.Image], path: Path, rate: float) -> None:
    import imageio_ffmpeg  # pyright: ignore[reportMissingImports]

    with path.open("ab"):  # the encoder's own word for a file that cannot be written is long
        pass
    # Not by its `write_frames`, which forks, of which jax warns.
    width, height = pictures[0].size
    raw = f"-f rawvideo -pix_fmt rgb24 -s {width}x{height} -r {rate:.6g} -i -"
    how = "-an -c:v libx264 -crf 18 -pix_fmt yuv420p -movflags +faststart"
    program = imageio_ffmpeg.get_ffmpeg_exe()
    command = [program, "-loglevel", "error", "-y", *raw.split(), *how.split(), str(path)]
    with subprocess.Popen(command, stdin=subprocess.PIPE) as process:
        for picture in pictures:
            process.stdin.write(picture.tobytes())  # pyright: ignore[reportOptionalMemberAccess]
    if process.returncode != 0:
        raise OSError(process.returncode, "the encoder failed")
