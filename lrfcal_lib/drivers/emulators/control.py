"""A socket through which other programs move the board of the emulated rig, and break its devices.

A line to it is a command with its arguments, ``place 3``, or the same as JSON, ``{"command": "place", "arguments":
[3]}``. Every line is answered by one line of JSON, ``{"ok": true, ...}`` or ``{"ok": false, "error": "..."}``.
"""

from __future__ import annotations

import contextlib
import json
import socketserver
import threading
from pathlib import Path

from lrfcal_lib.drivers.control import ask
from lrfcal_lib.drivers.emulators.faults import FAULTS

__all__ = ["COMMANDS", "ControlSocket", "ask", "obey"]

LONGEST_LINE = 4096


def _number(text):
    """A placement; None for 'none'."""
    return None if text in (None, "none", "") else int(text)


def _fault(rig, device, name, count=1, seconds=None):
    _device(rig, device).inject(name, int(count), seconds=None if seconds is None else float(seconds))
    return {"armed": sorted(rig.faults[device].armed)}


def _device(rig, name):
    if name not in rig.faults:
        raise ValueError(f"no device '{name}'; there are {', '.join(rig.faults)}")
    return rig.faults[name]


def _clear(rig, device=None):
    for name in rig.faults if device is None else [device]:
        _device(rig, name).clear()


COMMANDS = {
    "place": (lambda rig, number=None: rig.place(_number(number)), "place NUMBER|none: put the board there"),
    "close": (lambda rig, camera, view: rig.hold_close(camera, int(view)), "close CAMERA VIEW: hold it close"),
    "placements": (lambda rig: {"placements": rig.plan()["placements"]}, "placements: where the board can be put"),
    "fault": (_fault, "fault lrf|head NAME [COUNT] [SECONDS]: let something go wrong"),
    "faults": (
        lambda rig: {"faults": {n: f.text for n, f in FAULTS.items()},
                     "counts": {d: dict(f.counts) for d, f in rig.faults.items()}},
        "faults: what can go wrong, and how often it did",
    ),
    "clear": (_clear, "clear [lrf|head]: no more faults"),
    "status": (lambda rig: rig.status(), "status: the devices now"),
    "truth": (lambda rig: {"truth": rig.truth()}, "truth: what only the simulator knows"),
    "help": (lambda rig: {"commands": [text for _, text in COMMANDS.values()]}, "help: this"),
}  # fmt: skip


def obey(rig, line):
    """Do one command.

    Parameters
    ----------
    rig : EmulatedRig
    line : str

    Returns
    -------
    dict
        Never raises: an error is an answer.
    """
    try:
        if line.lstrip().startswith("{"):
            asked = json.loads(line)
            name, arguments = asked["command"], asked.get("arguments", [])
        else:
            name, *arguments = line.split() or ["help"]
        if name not in COMMANDS:
            raise ValueError(f"no command '{name}'; there are {', '.join(COMMANDS)}")
        return {"ok": True, **(COMMANDS[name][0](rig, *arguments) or {})}
    except (ValueError, TypeError, KeyError, AttributeError) as error:
        return {"ok": False, "error": f"{error}"}


class ControlSocket:
    """Serves the commands on a Unix socket.

    Parameters
    ----------
    path : path-like
    rig : EmulatedRig
    """

    def __init__(self, path, rig):
        self.path = Path(path)

        class Handler(socketserver.StreamRequestHandler):
            def handle(self):
                with contextlib.suppress(ConnectionError):
                    while line := self.rfile.readline(LONGEST_LINE):
                        answer = obey(rig, line.decode(errors="replace"))
                        self.wfile.write(json.dumps(answer).encode() + b"\n")

        class Server(socketserver.ThreadingMixIn, socketserver.UnixStreamServer):
            daemon_threads, block_on_close = True, False

        self._server, self._serving = Server(str(self.path), Handler), None

    def start(self):
        """Serve in a thread."""
        self._serving = threading.Thread(target=self._server.serve_forever, args=(0.2,), daemon=True)
        self._serving.start()

    def close(self):
        """Remove the socket."""
        if self._serving is not None:
            self._server.shutdown()
        self._server.server_close()
        self.path.unlink(missing_ok=True)
