"""`python -m jaxbeads SCENE`: the ready-made scenes from the shell."""

import argparse
import contextlib
import inspect
import json
import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import diffrax
import jax
import numpy as np

from .breakdown import SimulationError
from .cache import enable_cache
from .observables import curvature
from .outcome import Outcome
from .paraview import check_paraview, to_paraview
from .scenes import MODELS, SCENES, AbstractModel, AssemblyCase, Case, ReadyMade, Value
from .solution import Solution
from .solver import AB3, ESDIRK, AbstractSolver, Diffrax, Rosenbrock
from .tables import to_csv

_INTERRUPTED, _NO_READER = 128 + 2, 128 + 13  # as a shell reports SIGINT and SIGPIPE

AnyCase = Case | AssemblyCase


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m jaxbeads",
        description="Bead models of flexible fibres in Stokes flow: ready-made scenes.",
    )
    scenes = parser.add_subparsers(dest="scene", metavar="SCENE")
    for ready in SCENES:
        sub = scenes.add_parser(
            ready.name,
            help=ready.summary,
            description=ready.summary,
            epilog=_meanings(ready),
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )
        defaults = inspect.signature(ready.build).parameters
        for option, text in ready.options.items():
            _add_option(sub, option, defaults[option].default, text)
        sub.add_argument(
            "--solver",
            metavar="NAME",
            help="Rosenbrock, ESDIRK, AB3 or a diffrax solver, as Tsit5 (default: what the scene needs)",
        )
        sub.add_argument(
            "--tolerance",
            type=float,
            metavar="T",
            help="largest error of a step over the fibre's length (not for AB3)",
        )
        sub.add_argument(
            "--out", type=Path, metavar="DIR", help="write pictures, movie, trajectory, a table"
        )
        sub.add_argument("--paraview", action="store_true", help="beside them, files for ParaView")
        sub.add_argument("--quiet", action="store_true", help="print the results alone")
        sub.add_argument("--json", action="store_true", help="print the results as JSON, last line")
        sub.add_argument(
            "--no-cache",
            action="store_true",
            help="neither use nor keep compiled programs in the user's cache folder",
        )
    return parser


def _meanings(ready: ReadyMade) -> str:
    """What follows the options in a scene's help: its results, and a run of seconds."""
    width = max(map(len, ready.results))
    results = (f"  {name:<{width}}  {text}" for name, text in ready.results.items())
    example = f"python -m jaxbeads {ready.name} {ready.quick}"
    return "\n".join(["results:", *results, "", f"a quick example: {example}"])


def _add_option(parser: argparse.ArgumentParser, option: str, default: Any, text: str) -> None:
    flag = f"--{option.replace('_', '-')}"
    if isinstance(default, bool):
        parser.add_argument(flag, action="store_true", help=text)
    elif isinstance(default, AbstractModel):
        name = next(name for name, model in MODELS.items() if model is default)
        text = f"bead model (default {name})"
        parser.add_argument(flag, choices=list(MODELS), default=name, help=text)
    else:
        text = f"{text} (default {default})"
        parser.add_argument(flag, type=type(default), default=default, help=text)


def _adaptive_solver(name: str) -> diffrax.AbstractSolver | None:
    kinds = {k.lower(): v for k, v in vars(diffrax).items() if inspect.isclass(v)}
    kind = kinds.get(name.lower(), object)
    if not issubclass(kind, diffrax.AbstractAdaptiveSolver):
        return None
    try:
        solver = kind()
    except TypeError:  # an abstract class, or a solver made of another one
        return None
    # The others are for stochastic or split equations.
    return solver if solver.term_structure is diffrax.AbstractTerm else None


def _solver(name: str, tolerance: float | None) -> AbstractSolver:
    own = {"ab3": AB3, "esdirk": ESDIRK, "rosenbrock": Rosenbrock}
    if name.lower() in own:
        return own[name.lower()](tolerance=tolerance)
    scheme = _adaptive_solver(name)
    if scheme is None:
        raise ValueError(
            "Argument `--solver` must be Rosenbrock, ESDIRK, AB3 or the name of an adaptive diffrax "
            f"solver (Tsit5, Dopri5, Kvaerno3, Kvaerno5, ...), but it is {name!r}."
        )
    return Diffrax(scheme, tolerance=tolerance)


def _write(
    ready: ReadyMade, case: AnyCase, solution: Solution, folder: Path, paraview: bool
) -> list[Path]:
    from . import plot

    chain = case.scene.chain
    co_moving = case.scene.flow is None if ready.co_moving is None else ready.co_moving
    view = plot.View.of(case.scene, co_moving=co_moving, stretch=ready.stretch)
    label, measure = ready.plotted
    measured = measure(case, solution)
    table = {label.replace("$", ""): measured}
    written = [
        folder / f"{ready.name}{case.kind}",
        to_csv(folder / f"{ready.name}_observable.csv", solution.ts, table),
    ]
    if paraview:
        written.append(to_paraview(solution, case.scene, folder / f"{ready.name}.pvd"))
    pictures = {
        "shapes": plot.shapes(ready.shown(solution), chain, view=view),
        "observable": plot.observable(solution.ts, measured, label),
    }
    bends = isinstance(case, Case) and chain.fibres[0] > 2
    bent = curvature(solution.states.position, chain) if bends else np.zeros(1)
    if np.max(np.abs(bent)) * float(chain.length[0]) > 1e-6:
        pictures["curvature"] = plot.kymograph(solution, chain)
    for name, figure in pictures.items():
        written.append(folder / f"{ready.name}_{name}.png")
        figure.savefig(written[-1])
    kinds = (".gif", ".mp4") if plot.can_encode() else (".gif",)
    paths = [folder / f"{ready.name}{kind}" for kind in kinds]
    return [*written, *plot.movies(ready.filmed(solution), chain, paths, view=view)]


def _text(value: Value) -> str:
    if value is None or isinstance(value, bool):
        return {None: "none", True: "yes", False: "no"}[value]
    if isinstance(value, Sequence):
        return " ".join(_text(x) for x in value)
    return f"{value:.6g}"


def _run(ready: ReadyMade, arguments: argparse.Namespace) -> int:
    values = {name: getattr(arguments, name) for name in ready.options}
    if "model" in values:
        values["model"] = MODELS[values["model"]]
    case = ready.build(**values)
    options: dict[str, Any] = {"tolerance": arguments.tolerance}
    if arguments.solver is not None:
        options = {"solver": _solver(arguments.solver, arguments.tolerance)}
    folder: Path | None = arguments.out
    if arguments.paraview:
        if folder is None:
            raise ValueError("Argument `--paraview` must go with `--out`, but that is not given.")
        check_paraview()
    if folder is not None:
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise ValueError(
                f"Argument `--out` must be a folder that can be written, but {folder} is not: "
                f"{error.strerror}."
            ) from None
        options["file"] = folder / f"{ready.name}{case.kind}"
    solution = case.simulate(**options, progress=not arguments.quiet)
    if not arguments.quiet:
        print(solution.summary())
    interrupted = solution.status == Outcome.INTERRUPTED.word
    # What a scene shows at its end is not to be seen in a part of it.
    results = {} if interrupted else ready.observables(case, solution)
    for name, value in results.items():
        print(f"  {name:<24}{_text(value)}")
    if folder is not None and not interrupted:
        if not arguments.quiet:
            print("  drawing pictures and a movie ...")
        for path in _write(ready, case, solution, folder, arguments.paraview):
            if not arguments.quiet:
                print(f"  wrote {path}")
    if arguments.json:
        run = {
            "status": solution.status,
            "wall_s": _number(solution.wall_s),
            "compile_s": _number(solution.compile_s),
            "steps": int(solution.steps),
            "constraint_residual": float(np.max(np.asarray(solution.residual))),
            "bond_length_error": float(np.max(np.asarray(solution.bond_length_error))),
        }
        print(json.dumps({**results, **run}))
    return _INTERRUPTED if interrupted else 0


def _number(value: Any) -> float | None:
    """A number as JSON knows it; `None` for one that is not known."""
    number = float(np.asarray(value))
    return None if np.isnan(number) else number


def main(words: list[str] | None = None) -> int:
    """Run the shell command; returns its exit code: 0; 1 for what is refused or breaks down, which is
    said in one sentence; 130 after Ctrl-C; 141 if nobody reads what it prints, as after `| head`.
    """
    try:
        try:
            return _main(words)
        finally:  # what is still in the buffer, too, may find no reader
            sys.stdout.flush()
    except KeyboardInterrupt:
        print("Interrupted.", file=sys.stderr)
        return _INTERRUPTED
    except BrokenPipeError:
        # Python flushes once more when it ends, and would complain.
        nowhere = os.open(os.devnull, os.O_WRONLY)
        for stream in (sys.stdout, sys.stderr):
            os.dup2(nowhere, stream.fileno())
        return _NO_READER


def _main(words: list[str] | None) -> int:
    arguments = _parser().parse_args(words)
    if arguments.scene is None:
        print("Scenes (python -m jaxbeads SCENE --help shows a scene's options):")
        for ready in SCENES:
            print(f"  {ready.name:<18}{ready.summary}")
        return 0
    jax.config.update("jax_enable_x64", True)  # a program of its own may choose; a library may not
    if not arguments.no_cache:
        _keep_programs()
    ready = next(r for r in SCENES if r.name == arguments.scene)
    try:
        return _run(ready, arguments)
    except (ValueError, SimulationError) as error:
        print(error, file=sys.stderr)
        return 1


def _keep_programs() -> None:
    """Compiled programs for the next time; a folder that cannot be had is no fault of the run."""
    with contextlib.suppress(ValueError):
        enable_cache()


if __name__ == "__main__":
    _code = main()
    if _code == 130:
        # Ctrl-C may have left XLA at work on a program: taking the interpreter apart around it ends in
        # a segmentation fault.
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(_code)
    sys.exit(_code)
