"""Everything that can be made to go wrong with an emulated device: one registry, one switch board for each device."""

from __future__ import annotations

import threading
import time
from collections import Counter
from dataclasses import dataclass

import numpy as np

BOTH, LMS, HEAD = ("lrf", "head"), ("lrf",), ("head",)


@dataclass(frozen=True)
class Fault:
    """A kind of fault.

    Attributes
    ----------
    devices : tuple of str
        'lrf' or 'head', where it exists.
    text : str
        What happens at each injection.
    """

    devices: tuple[str, ...]
    text: str


FAULTS = {
    # on the bytes of a reply
    "drop": Fault(BOTH, "a byte of a reply is lost"),
    "flip": Fault(BOTH, "a bit of a reply is inverted"),
    "duplicate": Fault(BOTH, "a byte of a reply comes twice"),
    "insert": Fault(BOTH, "a byte appears within a reply"),
    "swap": Fault(BOTH, "two neighbouring, different bytes of a reply change places"),
    "blank": Fault(BOTH, "up to four bytes of a reply arrive as zero"),
    "cut": Fault(BOTH, "a reply ends early"),
    "headless": Fault(BOTH, "a reply lacks its beginning"),
    "noise": Fault(BOTH, "1 to 20 bytes of noise come before a reply"),
    "checksum": Fault(BOTH, "a reply has the wrong checksum"),
    "address": Fault(BOTH, "a reply with a sound checksum comes from another address"),
    "foreign": Fault(BOTH, "a sound reply that nobody asked for comes first"),
    "length": Fault(LMS, "a telegram states another length; its checksum fits the bytes"),
    # on when and whether a reply comes
    "silence": Fault(BOTH, "a reply is not sent"),
    "delay": Fault(BOTH, "a reply comes 0.7 s late"),
    "pause": Fault(BOTH, "a reply stops for 80 ms in the middle"),
    "twice": Fault(BOTH, "a reply is sent twice"),
    "stale": Fault(BOTH, "the previous reply of the same kind is sent in place of the present one"),
    # on the line
    "request_drop": Fault(BOTH, "a byte that the host sends is lost"),
    "request_flip": Fault(BOTH, "a bit that the host sends is inverted"),
    "deaf": Fault(BOTH, "what the host sends does not arrive"),
    "echo": Fault(BOTH, "what the host sends comes back to it first, as on two-wire RS-485"),
    "unplug": Fault(BOTH, "the port vanishes and comes back at the same path (after 0.5 s unless told otherwise)"),
    # in the laser range finder
    "nak": Fault(LMS, "a sound request is answered NAK"),
    "no_ack": Fault(LMS, "the reply comes without ACK"),
    "refused": Fault(LMS, "a request is answered ACK and 0x92"),
    "reboot": Fault(LMS, "the device restarts: silence, 9600 Bd, the power-on string, settings of the factory"),
    "rate": Fault(LMS, "the device falls to another baud rate without a word"),
    "stuck": Fault(LMS, "the command to stop streaming is confirmed, and streaming goes on"),
    "slow_mode": Fault(LMS, "a change of the operating mode takes 2.8 s, as long as the manual allows"),
    "skip": Fault(LMS, "a scan of the stream is not sent; the indices go on"),
    "status": Fault(LMS, "the status byte says error, dirty window, implausible values"),
    # in the head
    "mute": Fault(HEAD, "a query is not answered, though the head obeys"),
    "stall": Fault(HEAD, "a motion command does not move the head"),
    "slip": Fault(HEAD, "the head runs on for 0.3 s after a stop"),
    "jump": Fault(HEAD, "a position reply with a sound checksum is wrong by 10 deg"),
}


class Faults:
    """Switches of one device; all that is random follows from the seed.

    Parameters
    ----------
    device : {'lrf', 'head'}
    seed : int

    Attributes
    ----------
    counts : collections.Counter
        How often each kind was injected.
    """

    def __init__(self, device, seed=0):
        self.device, self.counts = device, Counter()
        self.rng = np.random.default_rng([seed, *device.encode()])
        self._lock, self._armed, self._until, self._chance, self._seconds = threading.Lock(), Counter(), {}, {}, {}
        self.changed = lambda: None

    def inject(self, name, count=1, *, seconds=None):
        """Arm a fault.

        Parameters
        ----------
        name : str
            Key of `FAULTS`.
        count : int
            It happens at that many opportunities (replies, requests, ...) from now on.
        seconds : float, optional
            At every opportunity for so long instead; for 'unplug' how long the port is away.

        Raises
        ------
        ValueError
            For a fault that this device does not know.
        """
        self._known(name)
        with self._lock:
            if seconds is None or name == "unplug":
                self._armed[name] += count
                self._seconds[name] = seconds
            else:
                self._until[name] = time.monotonic() + seconds
        self.changed()

    def chance(self, name, probability):
        """Let a fault happen with a probability at every opportunity; 0 ends that."""
        self._known(name)
        with self._lock:
            self._chance[name] = probability

    def clear(self, name=None):
        """Disarm one fault, or all."""
        with self._lock:
            for board in (self._armed, self._until, self._chance):
                board.clear() if name is None else board.pop(name, None)

    @property
    def armed(self):
        """Names of the faults that can still happen, a set."""
        with self._lock:
            now, everything = time.monotonic(), (self._armed, self._chance)
            timed = {name for name, end in self._until.items() if end > now}
            return timed.union(*({name for name, left in board.items() if left > 0} for board in everything))

    def hit(self, name):
        """Whether the fault happens at this opportunity, which is then counted."""
        with self._lock:
            armed = self._armed[name] > 0
            hit = armed or time.monotonic() < self._until.get(name, 0) or self._by_chance(name)
            if armed:
                self._armed[name] -= 1
            if hit:
                self.counts[name] += 1
            return hit

    def seconds(self, name, default):
        """How long the fault that was armed last is to take."""
        seconds = self._seconds.get(name)
        return default if seconds is None else seconds

    def _by_chance(self, name):
        probability = self._chance.get(name, 0)
        return bool(probability) and self.rng.random() < probability

    def _known(self, name):
        if name not in FAULTS or self.device not in FAULTS[name].devices:
            known = ", ".join(n for n, f in FAULTS.items() if self.device in f.devices)
            raise ValueError(f"no fault '{name}' of device '{self.device}'; there are {known}")


# ------------------------------------------------------------------------------------------- what they do to bytes


def _somewhere(data, rng):
    return int(rng.integers(len(data)))


def _drop(data, rng):
    at = _somewhere(data, rng)
    return data[:at] + data[at + 1 :]


def _flip(data, rng):
    at = _somewhere(data, rng)
    return data[:at] + bytes([data[at] ^ 1 << int(rng.integers(8))]) + data[at + 1 :]


def _duplicate(data, rng):
    at = _somewhere(data, rng)
    return data[: at + 1] + data[at:]


def _insert(data, rng):
    at = 1 + _somewhere(data, rng)
    return data[:at] + rng.bytes(1) + data[at:]


def _swap(data, rng):
    places = [i for i in range(len(data) - 1) if data[i] != data[i + 1]]
    if not places:
        return data
    at = places[int(rng.integers(len(places)))]
    return data[:at] + data[at + 1 : at + 2] + data[at : at + 1] + data[at + 2 :]


def _blank(data, rng):
    places = [i for i, byte in enumerate(data) if byte]
    at = places[int(rng.integers(len(places)))] if places else 0
    size = len(data[at : at + 4])
    return data[:at] + bytes(size) + data[at + size :]


def _cut(data, rng):
    return data[: _somewhere(data, rng)]


def _headless(data, rng):
    return data[1 + _somewhere(data, rng) :]


def _noise(data, rng):
    return rng.bytes(int(rng.integers(1, 21))) + data


def _checksum(data, rng):
    return data[:-1] + bytes([data[-1] ^ int(rng.integers(1, 256))])


MANGLE = {
    "drop": _drop, "flip": _flip, "duplicate": _duplicate, "insert": _insert, "swap": _swap, "blank": _blank,
    "cut": _cut, "headless": _headless, "noise": _noise, "checksum": _checksum,
}  # fmt: skip
REQUEST = {"request_drop": _drop, "request_flip": _flip, "deaf": lambda data, rng: b""}


def mangle(data, faults, table=None):
    """Bytes as they are after the faults that hit them.

    Parameters
    ----------
    data : bytes
    faults : Faults
    table : dict, optional
        Name of the fault to function (data, rng) -> data; those of a reply by default.

    Returns
    -------
    bytes
    """
    for name, change in (MANGLE if table is None else table).items():
        if data and faults.hit(name):
            data = change(data, faults.rng)
    return data
