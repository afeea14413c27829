"""``python -m lrfcal_lib emulate``: the emulated rig for other programs, until Ctrl-C."""

from __future__ import annotations

import argparse
import json
import signal
import threading
from pathlib import Path

from lrfcal_lib.drivers.emulators.pelco_d import FEEDBACK, REPLIES

LOOK_S = 0.5
SCALE_HELP = "2 runs all devices twice as fast, 8 at most; stop-and-go only, as sweeps need scans in real time (1)"


def parser():
    """The command line.

    Returns
    -------
    argparse.ArgumentParser
    """
    top = argparse.ArgumentParser(prog="python -m lrfcal_lib emulate", description="Emulate the devices of a rig.")
    top.add_argument("setup", nargs="?", default="sim_quick", help="sim_quick (default) or sim_lms221")
    top.add_argument("--folder", help="where the ports appear (default: a new temporary folder)")
    top.add_argument("--rig-file", help="write a file for 'record' (it is removed at the end)")
    top.add_argument("--seed", type=int, default=0, help="of noise and faults")
    top.add_argument("--feedback", choices=FEEDBACK, default="full", help="what the head tells of its position")
    top.add_argument("--reply", choices=REPLIES, default="extended", help="how the head answers")
    top.add_argument("--echo", action="store_true", help="the head's line hands back what is sent")
    top.add_argument("--head-baudrate", type=int, default=2400)
    top.add_argument("--model", help="type string of the laser range finder, 21 characters")
    top.add_argument("--image-width", type=int, help="pixels")
    top.add_argument("--image-rest", type=float, default=0.5, help="s the head rests before an image is drawn (0.5)")
    top.add_argument("--no-cameras", action="store_true")
    top.add_argument("--time-scale", type=float, default=1.0, help=SCALE_HELP)
    return top


def main(argv=None):
    """Emulate a rig until Ctrl-C, SIGTERM or SIGHUP.

    Parameters
    ----------
    argv : list of str, optional

    Returns
    -------
    int
        0, or 1 when a device ended by itself.

    Raises
    ------
    ValueError
        For options that no rig has.
    """
    args = parser().parse_args(argv)
    quit_ = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        if number != signal.SIGHUP or signal.getsignal(number) != signal.SIG_IGN:  # as nohup leaves it
            signal.signal(number, lambda *_: quit_.set())
    with _rig(args) as rig:
        file = None if args.rig_file is None else Path(args.rig_file)
        try:
            if file is not None:
                file.write_text(json.dumps(rig.rig_file(), indent=1) + "\n")
            print(summary(rig, file), flush=True)
            while not quit_.wait(LOOK_S) and rig.error() is None:
                pass
        finally:
            if file is not None:
                file.unlink(missing_ok=True)
        error = rig.error()
    print(f"a device ended: {error!r}" if error else "the emulated rig is gone", flush=True)
    return 1 if error else 0


def _rig(args):
    from lrfcal_lib.drivers.emulators.rig import EmulatedRig

    head = {"feedback": args.feedback, "reply": args.reply, "echo": args.echo, "baudrate": args.head_baudrate}
    return EmulatedRig(
        args.setup, folder=args.folder, seed=args.seed, time_scale=args.time_scale, cameras=not args.no_cameras,
        image_width=args.image_width, rest_s=args.image_rest, head_options=head,
        lrf_options={"model": args.model} if args.model else None,
    )  # fmt: skip


def summary(rig, file=None):
    """What other programs need to know of an emulated rig, as text."""
    beam, head = rig.setup.rig.beam, rig.pan_tilt
    lines = [
        f"emulated rig '{rig.setup.name}' ({beam.name}); Ctrl-C ends it",
        f"  lrf      {rig.lrf_port}   {rig.lrf.baudrate} Bd, SICK LMS2xx",
        f"  head     {rig.head_port}   {head.baudrate} Bd, Pelco-D, address {head.address}",
        *(f"  {name:8s} {url}" for name, url in rig.camera_urls.items()),
        f"  control  {rig.control}   one command a line, such as: place 1",
        f"  boards   placements {', '.join(map(str, rig.world.placements))}, or none",
    ]
    if rig.clock.scale != 1:
        lines.append(f"  clocks   {rig.clock.scale:g} times as fast: for stop-and-go, not for continuous sweeps")
    if file is not None:
        lines.append(f"  rig file {file}   python -m lrfcal_lib record --help")
    return "\n".join(lines)
