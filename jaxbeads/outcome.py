"""`Outcome`: how a trajectory went, as a number for programs and a sentence for people."""

from enum import IntEnum


class Outcome(IntEnum):
    """What the `code` of a `Solution`, or of a member of a `sweep`, means.

    Members are whole numbers, with which compiled programs compute.
    """

    sentence: str

    def __new__(cls, number: int, sentence: str) -> "Outcome":
        one = int.__new__(cls, number)
        one._value_, one.sentence = number, sentence
        return one

    NOT_RUN = -1, "Not run: interrupted."
    FINE = 0, "All numbers are finite, bonds kept their lengths, and prescribed motion its laws."
    TOO_MANY_STEPS = 1, "More than `max_steps` steps between two times."
    GAVE_UP = 2, "The solver gave up."
    BROKEN = 3, "Positions are not finite, or bonds are off their lengths by more than 1 %."
    NOT_MEASURED = 4, "What is measured is not finite."
    OFF_ITS_LAW = (
        5,
        "Prescribed places, directions or lengths are off their laws by more than 1 %, as where a law "
        "jumps.",
    )


def meaning(code: int) -> str:
    """What a code means, within a sentence; also of one that is none, as in a difference of two."""
    if code not in set(Outcome):
        return "not one of a run"
    sentence = Outcome(code).sentence
    return sentence[0].lower() + sentence[1:].rstrip(".")
