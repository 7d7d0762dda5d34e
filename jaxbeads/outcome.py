"""`Outcome`: how a trajectory went and how a run ended: a number for programs, words for people."""

from enum import IntEnum


class Outcome(IntEnum):
    """What the `code` of a `Solution`, or of a member of a `sweep`, means, and its `ending`.

    Members are whole numbers, with which compiled programs compute. Those of endings are such that a sum
    or a difference of two is none of them: solutions may be subtracted.

    >>> from jaxbeads import Outcome
    >>> print(Outcome.FINE == 0, Outcome(3).word, Outcome(103).word)
    True broken interrupted
    """

    word: str
    sentence: str

    def __new__(cls, number: int, word: str, sentence: str) -> "Outcome":
        """A whole number with its word and its sentence."""
        one = int.__new__(cls, number)
        one._value_, one.word, one.sentence = number, word, sentence
        return one

    NOT_RUN = -1, "not run", "Not run: interrupted."
    FINE = (
        0,
        "fine",
        "All numbers are finite, bonds kept their lengths, and prescribed motion its laws.",
    )
    TOO_MANY_STEPS = 1, "too many steps", "More than `max_steps` steps between two times."
    GAVE_UP = 2, "gave up", "The solver gave up."
    BROKEN = (
        3,
        "broken",
        "Positions are not finite, or bonds are off their lengths by more than 1 %.",
    )
    NOT_MEASURED = 4, "not measured", "What is measured is not finite."
    OFF_ITS_LAW = (
        5,
        "off its law",
        "Prescribed places, directions or lengths are off their laws by more than 1 %, as where a law "
        "jumps.",
    )

    FINISHED = 101, "finished", "All times are there."
    STOPPED = (
        102,
        "stopped by `until`",
        "The condition `until` was true of the solution up to its last time.",
    )
    INTERRUPTED = 103, "interrupted", "Ctrl-C came before the last time."
    UNFINISHED = 104, "unfinished", "The file holds a part of its times; `resume` continues it."
    BROKEN_DOWN = 105, "broken down", "It ends with its last good state, or its `code` says why."

    @property
    def is_ending(self) -> bool:
        """Whether it says how a run ended, not what its numbers are worth."""
        return self >= Outcome.FINISHED


def meaning(code: int) -> str:
    """What a code means, within a sentence; also of one that is none, as in a difference of two."""
    if code not in set(Outcome):
        return "not one of a run"
    sentence = Outcome(code).sentence
    return sentence[0].lower() + sentence[1:].rstrip(".")
