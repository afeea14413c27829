"""How long this machine lets a thread or a pseudo-terminal wait: what a test in real time must allow for."""

import os
import threading
import time
import tty


class Hiccups(threading.Thread):
    """Times for which this machine let a byte wait that was due, s: a scan or a reply may come in so much later.

    The thread sleeps a little and sends itself a byte: what is late may be the thread, or the kernel's own work on the
    line.
    """

    def __init__(self):
        super().__init__(daemon=True)
        self.waits, self.over = [], threading.Event()  # when a wait was over, and how long it was

    def run(self):
        near, far = os.openpty()
        tty.setraw(far)
        while not self.over.is_set():
            begin = time.monotonic()
            time.sleep(0.01)
            os.write(near, b"x")
            os.read(far, 1)
            end = time.monotonic()
            self.waits.append((end, end - begin - 0.01))
        os.close(near)
        os.close(far)

    @property
    def longest(self):
        return max(wait for _, wait in self.waits)

    def within(self, begin, end):
        """Sum of the waits that were at least partly between two instants."""
        return sum(wait for over, wait in self.waits if over > begin and over - wait < end)
