"""How long this machine lets a thread wait that is due: what a test in real time must allow for."""

import threading
import time


class Hiccups(threading.Thread):
    """Times for which this machine let a thread wait that was due, s: a scan or a reply may come in so much later."""

    def __init__(self):
        super().__init__(daemon=True)
        self.waits, self.over = [], threading.Event()  # when a wait was over, and how long it was

    def run(self):
        while not self.over.is_set():
            begin = time.monotonic()
            time.sleep(0.01)
            end = time.monotonic()
            self.waits.append((end, end - begin - 0.01))

    @property
    def longest(self):
        return max(wait for _, wait in self.waits)

    def within(self, begin, end):
        """Sum of the waits that were at least partly between two instants."""
        return sum(wait for over, wait in self.waits if over > begin and over - wait < end)
