"""What a person sees of a run while it goes on, and how long the host lets the device go on alone."""

import math
import threading
import time
from collections.abc import Callable
from typing import Any

_LOOK = 0.5
"""Seconds between two looks at a run, about."""
_MOST = 2**30


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

    def tell(self, t: float, steps: int) -> None:
        """The time reached, and the steps that it took."""
        self.begun = True
        if not self.bar.disable:
            self.bar.set_description_str(
                f"t = {t:.4g} of {self.last:.4g}, {steps} steps", refresh=False
            )
            self.bar.update(self._part(t) - self.bar.n)


class Pace:
    """How many steps the device takes before the host looks again.

    One at first, in whose time compiling counts; a few, to learn how long they take; then as many as
    half a second holds.
    """

    def __init__(self) -> None:
        self.most, self._next = 1, 8

    def taken(self, steps: int, seconds: float) -> None:
        """The last steps took so long."""
        if self._next:
            self.most, self._next = self._next, 0
        elif steps:
            wanted = int(_LOOK * steps / max(seconds, 1e-9))
            self.most = max(1, min(wanted, 16 * self.most, _MOST))

    def begin(self) -> None:
        """A stretch begins."""
        self._began = time.perf_counter()

    def end(self, steps: int) -> None:
        """It has ended, after so many steps."""
        self.taken(steps, time.perf_counter() - self._began)
