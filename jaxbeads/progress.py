"""What a person sees of a run while it goes on, and how long the host lets the device go on alone."""

import math
import sys
import threading
import time
from collections.abc import Callable
from typing import Any, NamedTuple

from .rollout import Stepper
from .solver import FixedSteps

_LOOK = 0.5
"""Seconds between two looks at a run, about."""
_MOST = 2**30
_LONG = 60.0
"""Seconds of a run that is foretold."""
_CALL = 0.02
"""Seconds that are much longer than a call of a program."""
_SOME = 100
"""Steps whose time is foretold where nobody knows their number."""


class Bar:
    """A progress bar of the simulated time, which also ticks while a program is compiled.

    The program of the steps is compiled last, and JAX tells how long only when it ends. It takes about
    as long as what the run has compiled before it (AB3's a third of that), so that is what is expected.

    **Arguments**: first and last time; the time at which the run begins; whether anything is shown;
    what tells the seconds of compiling that have ended.
    """

    def __init__(
        self,
        first: float,
        last: float,
        now: float,
        shown: bool,
        compiled: Callable[[], float] = lambda: math.nan,
    ) -> None:
        from tqdm.auto import tqdm  # it warns on import in a notebook without widgets

        self.first, self.last, self.compiled = first, last, compiled
        self.bar: Any = tqdm(
            desc="compiling",
            total=1.0,
            initial=self._part(now),
            disable=not shown,
            bar_format="{desc}: {percentage:3.0f}%|{bar}| {elapsed}<{remaining}",
        )
        self.begun, self.over = False, threading.Event()
        if shown:
            threading.Thread(target=self._tick, daemon=True).start()

    def __enter__(self) -> "Bar":
        return self

    def __exit__(self, *_: object) -> None:
        self.over.set()
        self.bar.close()

    def _part(self, t: float) -> float:
        return (t - self.first) / (self.last - self.first)

    def _tick(self) -> None:
        while not self.over.wait(1.0):
            expected = self.compiled()
            if not self.begun and expected > 0.5:
                self.bar.set_description_str(f"compiling, about {expected:.0f} s", refresh=False)
            self.bar.refresh()

    def say(self, sentence: str) -> None:
        """Something above the bar, where there is one."""
        if not self.bar.disable:
            self.bar.write(sentence, file=sys.stderr)

    def tell(self, t: float, steps: int) -> None:
        """The time reached, and the steps that it took."""
        self.begun = True
        if not self.bar.disable:
            self.bar.set_description_str(
                f"t = {t:.4g} of {self.last:.4g}, {steps} steps", refresh=False
            )
            self.bar.update(self._part(t) - self.bar.n)


class Forecast(NamedTuple):
    """What a run will take, before its first step.

    Equal steps are counted. How many steps a controller will choose shows on the way alone (a fibre that
    has found its shape takes one in the time of a hundred before), and so the time of a hundred is told.
    """

    beads: int
    steps: int | None
    """How many; `None` if they are chosen on the way."""
    evaluations: float
    """Evaluations of the velocities that take as long as a step, about."""
    seconds: float
    """Of an evaluation."""

    @classmethod
    def of(cls, stepper: Stepper, beads: int, intervals: int, seconds: float) -> "Forecast":
        """Of so many intervals."""
        equal = isinstance(stepper, FixedSteps)
        steps = intervals * stepper.substeps if equal else None
        return cls(beads, steps, stepper.solver.evaluations, seconds)

    @property
    def known(self) -> bool:
        """Whether an evaluation takes much longer than its call: else steps must show what they take."""
        return self.seconds > _CALL

    def after(self, steps: int, seconds: float) -> "Forecast":
        """By the time that some steps took."""
        return self._replace(seconds=seconds / (steps * self.evaluations))

    @property
    def whole(self) -> float:
        """Seconds of all steps, or of a hundred."""
        return (_SOME if self.steps is None else self.steps) * self.evaluations * self.seconds

    @property
    def long(self) -> bool:
        """Whether it is worth telling."""
        return self.whole > _LONG

    def sentence(self, memory: int | None) -> str:
        """In words, with the bytes that the program of the steps holds."""
        held = "" if memory is None else f", {memory / 2**30:.2g} GiB of memory"
        times = "" if self.evaluations == 1 else f"{self.evaluations:g} times "
        each = f"about {span(self.evaluations * self.seconds)} each (as {times}the velocities)"
        if self.steps is not None:
            each = f"{self.steps} steps of {each}, {span(self.whole)} in all"
        else:
            each = f"steps of {each}, {span(self.whole)} for {_SOME}; how many shows on the way"
        return f"{self.beads} beads{held}: {each}"


def span(seconds: float) -> str:
    """A length of time for people, in two digits."""
    for size, unit in ((86400.0, "days"), (3600.0, "h"), (60.0, "min")):
        if seconds >= 1.5 * size:
            seconds, name = seconds / size, unit
            break
    else:
        name = "s"
    digits = max(0, 1 - math.floor(math.log10(max(seconds, 1e-9))))
    return f"{seconds:.{digits}f} {name}" if seconds < 10 else f"{seconds:.0f} {name}"


class Pace:
    """How many steps the device takes before the host looks again.

    One at first, in whose time compiling counts; a few, to learn how long they take; then as many as
    half a second holds.
    """

    def __init__(self) -> None:
        self.most, self._next = 1, 8
        self._told = 0, 0.0

    def taken(self, steps: int, seconds: float) -> None:
        """The last steps took so long."""
        if self._next:
            self.most, self._next = self._next, 0
        elif steps:
            self._told = self._told[0] + steps, self._told[1] + seconds
            wanted = int(_LOOK * steps / max(seconds, 1e-9))
            self.most = max(1, min(wanted, 16 * self.most, _MOST))

    @property
    def each(self) -> float | None:
        """Seconds of a step, once they are known."""
        steps, seconds = self._told
        return seconds / steps if seconds > _CALL else None

    def begin(self) -> None:
        """A stretch begins."""
        self._began = time.perf_counter()

    def end(self, steps: int) -> None:
        """It has ended, after so many steps."""
        self.taken(steps, time.perf_counter() - self._began)
