"""How long something will still take, in words, on a terminal or in a file."""

import time

# between lines where none can be written over: a file or a pipe instead of a terminal
LINE_S = 10.0


class Progress:
    """Of something that began now.

    Parameters
    ----------
    clock : callable
        The present time, seconds.
    """

    def __init__(self, clock=time.monotonic):
        self._clock = clock
        self._begun = clock()
        self._said = clock()

    @property
    def seconds(self) -> float:
        """Since it began."""
        return self._clock() - self._begun

    def left(self, share: float) -> str:
        """How long it will still take, in words; '' where nothing is done yet, or all.

        Parameters
        ----------
        share
            That is done, 0 to 1.
        """
        if not 0 < share < 1:
            return ""
        return f"about {duration(self.seconds * (1 - share) / share)} left"

    def due(self) -> bool:
        """Whether it is time for another line; then it counts as written."""
        now = self._clock()
        if now - self._said < LINE_S:
            return False
        self._said = now
        return True


def duration(seconds: float) -> str:
    """A time as text, in minutes from 100 s on.

    Parameters
    ----------
    seconds
    """
    return f"{seconds:.0f} s" if seconds < 100 else f"{seconds / 60:.0f} min"
