"""Ask an emulated rig, in this process or another, to move its board or to break something."""

from __future__ import annotations

import json
import socket


def ask(path, line, timeout=10.0):
    """Send one command to the control socket of an emulated rig.

    Parameters
    ----------
    path : path-like
        Of the socket.
    line : str or dict
    timeout : float
        Seconds.

    Returns
    -------
    dict

    Raises
    ------
    ValueError
        If the rig refuses, with its reason.
    OSError
        If nobody serves the socket.
    """
    line = json.dumps(line) if isinstance(line, dict) else line
    with socket.socket(socket.AF_UNIX) as link:
        link.settimeout(timeout)
        link.connect(str(path))
        link.sendall(line.encode() + b"\n")
        answer = json.loads(link.makefile().readline())
    if not answer.pop("ok"):
        raise ValueError(f"the emulated rig refuses '{line}': {answer['error']}")
    return answer
