"""Devices in virtual time: no time passes but what a test waits for, so that every run is the same and instant."""

import numpy as np

from lrfcal_lib.drivers.host import VirtualHost
from lrfcal_lib.emulators.head import EmulatedHead
from lrfcal_lib.emulators.line import Clock
from lrfcal_lib.emulators.lms2xx import EmulatedLms
from lrfcal_lib.session.lms2xx_codec import Configuration, split_stream

INDEXED = Configuration().changed(unit="mm", realtime_indices=True)


class Source:
    """Scans that are a cheap function of the mirror's turn: no two in a row alike, every range within 8 m."""

    def scan(self, turn, quarters, times):
        reasons = np.where((quarters + turn) % 97 == 0, 1 + turn % 2 * 3, 0)
        return 1.0 + (quarters * 13 + turn * 37) % 6000 / 1000, reasons, np.full(2, np.nan)


def lms(source=None, host=None, **options):
    """An emulated LMS2xx on a virtual host of its own, with its port."""
    clock = Clock(machine=host or VirtualHost())
    return EmulatedLms(source or Source(), path="lrf", clock=clock, **options).start()


def head(host=None, **options):
    """An emulated head on a virtual host of its own, with its port."""
    return EmulatedHead(path="head", clock=Clock(machine=host or VirtualHost()), **options).start()


def telegrams(data):
    """The sound telegrams of a device in a row of bytes."""
    found = split_stream(bytes(data))
    return [bytes(data[o : o + n]) for o, n in zip(found.offset.tolist(), found.length.tolist(), strict=True)]


class Bench:
    """A program at the other end of a device's line; its rate is the device's unless one is given."""

    def __init__(self, device, rate=None):
        self.device, self.rate, self.machine, self.out = device, rate, device.clock.machine, []
        self.port, put = self.machine.port(device.path, rate or device.baudrate, timeout=0), device.port.put

        def noted(data):
            self.out += [(self.now, byte) for byte in data]
            return put(data)

        device.port.put = noted

    now = property(lambda self: self.device.clock.now())
    heard = property(lambda self: bytes(byte for _, byte in self.out))

    def ask(self, raw):
        """Send a request (bytes, or hexadecimal digits); what came before is forgotten."""
        self.port.baudrate = self.rate or self.device.baudrate
        self.port.reset_input_buffer()
        self.out.clear()
        self.port.write(bytes.fromhex(raw) if isinstance(raw, str) else raw)

    def send(self, raw, wait=1.0):
        """What comes back within a while."""
        self.ask(raw)
        return self.run(wait)

    def run(self, wait):
        """Let time pass; all that came back so far."""
        self.machine.sleep(wait)
        self.port.reset_input_buffer()
        return self.heard

    def reply(self, raw, code, wait=1.0, tries=3):
        """Ask until a reply of that code comes, within a time each; one byte is read at a time."""
        for _ in range(tries):
            self.ask(raw)
            end = self.now + wait
            while self.now < end:
                found = self.read(end - self.now)
                if found is not None and found[4] == code:
                    return found
        raise AssertionError(f"no reply {code:02X} in {tries} tries of {wait} s")

    def read(self, wait):
        """The next sound telegram within a time; None without."""
        end, data = self.now + wait, b""
        while self.now < end and not telegrams(data):
            self.machine.wait(lambda: self.port.in_waiting, end - self.now)
            data += self.port.read(1)
        return next(iter(telegrams(data)), None)
