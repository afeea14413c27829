"""A whole emulated rig: its devices in one world, and ``python -m lrfcal_lib emulate``."""

import contextlib
import json
import os
import signal
import tempfile
import threading
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from lrfcal_lib.drivers.lms2xx_link import FASTEST
from lrfcal_lib.drivers.port import REAL, Closed, Host
from lrfcal_lib.emulators.head import EmulatedHead
from lrfcal_lib.emulators.lms2xx import EmulatedLms
from lrfcal_lib.emulators.world import CameraServer, EmulatedWorld
from lrfcal_lib.session import stated
from lrfcal_lib.simulate.rig import Placement, Setup, load_setup, placements_of

# that says nothing about an emulated camera: it sends no image while the head moves
SILENCE_S = 600.0
LOOK_S = 0.5
PRACTICE = "practice"
QUICK_HEAD = {"baudrate": 38400, "go_speed": 60.0}  # habits
QUICK_SETTINGS = {"settle_s": 0.05, "poll_s": 0.01, "gap_s": 0.005}  # of its driver


class EmulatedRig(Closed):
    """The devices of a simulated setup, as files and addresses that any program can open.

    A context manager that removes them, and their folder.

    Parameters
    ----------
    setup
        What to emulate.
    placements
        Where the board can be put, see :class:`EmulatedWorld`.
    quick
        Its head is quick, and the rig file says so.
    rest_s
        Of :class:`CameraServer`.
    host
        Whose time the devices live in, and whose ``terminal(device)`` their ports are.
    **habits
        Of :class:`EmulatedHead`.

    Examples
    --------
    >>> with EmulatedRig(load_setup("sim_quick")) as rig:  # doctest: +SKIP
    ...     rig.world.put("place/1")
    """

    def __init__(
        self,
        setup: Setup,
        *,
        placements: Sequence[Placement] | None = None,
        quick: bool = False,
        rest_s: float = 0.5,
        host: Host = REAL,
        **habits,
    ):
        self.setup = setup
        self.host = host
        self.quick = quick
        if quick:
            habits |= QUICK_HEAD
        with contextlib.ExitStack() as stack:
            folder = tempfile.TemporaryDirectory(
                prefix="lrfcal-", ignore_cleanup_errors=True
            )
            self.folder = Path(stack.enter_context(folder))
            self.world = EmulatedWorld(setup, host, placements)
            self.camera_server = stack.enter_context(
                CameraServer(self.world, rest_s=rest_s)
            )
            self.camera_urls = {
                name: f"{self.camera_server.url}/{name}.mjpg"
                for name in self.camera_server.cameras
            }
            self.lrf = stack.enter_context(
                EmulatedLms(self.world, path=self.folder / "lrf", host=host)
            )
            self.pan_tilt = stack.enter_context(
                EmulatedHead(
                    self.world.head, path=self.folder / "head", host=host, **habits
                )
            )
            self.close = stack.pop_all().close

    def error(self) -> Exception | None:
        """What ended a device by itself, None while all live."""
        return self.lrf.error or self.pan_tilt.error

    def rig_file(self) -> dict:
        """Statement of the rig for recording, as JSON: board and rig as in session.json, devices,
        plan. Without close views of the board nobody can find the intrinsics, so they are stated.
        """
        setup = self.setup
        rig = setup.rig
        return {
            "licence": "CC-BY-4.0",
            "simulated": True,
            "source": f"emulated rig of the setup '{setup.name}', seed {setup.seed}",
            "board": stated.board_to_json(rig.board),
            "rig": stated.rig_to_json(
                rig.beam.info("emulated"),
                rig.T_head_lrf_stated,
                rig.camera_infos(known=setup.intrinsics_views == 0),
            ),
            "devices": self._devices(),
            "plan": {
                "intrinsics_images": setup.intrinsics_views,
                "placements": [
                    {
                        "number": p.number,
                        "board": p.purpose == "board",
                        "pitch_deg": np.degrees(p.sweep).round(4).tolist(),
                        "image_pitch_deg": np.degrees(p.image_pitch).round(4).tolist(),
                    }
                    for p in self.world.placements
                ],
            },
        }

    def _devices(self):
        """Where the devices are, and how they are to be set."""
        rig = self.setup.rig
        head = self.pan_tilt
        stated_head = {
            "port": head.path,
            "address": head.habits.address,
            "baudrate": head.baudrate,
            "feedback": head.habits.feedback != "none",
            "pitch_limits_deg": np.degrees(rig.platform.limits).round(6).tolist(),
        }
        if self.quick:
            stated_head |= QUICK_SETTINGS
        return {
            "lrf": {
                "port": self.lrf.path,
                "baudrate": FASTEST,
                "interlaced": False,
                "unit": rig.beam.unit_name,
                "variant": [rig.beam.field_of_view, rig.beam.resolution / 100],
            },
            "head": stated_head,
            "cameras": {
                camera.name: {
                    "source": self.camera_urls[camera.name],
                    "silence_s": SILENCE_S,
                    "size": [camera.model.width, camera.model.height],
                }
                for camera in rig.cameras
            },
            "control": self.camera_server.control,
        }


def practice_setup() -> tuple[Setup, list[Placement]]:
    """A rig and placements that are recorded in a minute."""
    setup = load_setup(PRACTICE)
    return setup, [
        replace(p, image_pitch=(p.image_pitch[0], p.image_pitch[-1]))
        for p in placements_of(setup)
    ]


def emulated(name: str, feedback: str = "full") -> EmulatedRig:
    """An emulated rig.

    Parameters
    ----------
    name
        'practice', or a set-up.
    feedback
        Of the head, see :class:`Habits`.

    Raises
    ------
    ValueError
        For another name.
    """
    if name == PRACTICE:
        setup, placements = practice_setup()
        return EmulatedRig(setup, placements=placements, feedback=feedback, quick=True)
    return EmulatedRig(load_setup(name), feedback=feedback)


def main(
    name: str, rig_file: str | os.PathLike | None = None, feedback: str = "full"
) -> int:
    """Emulate a set-up until Ctrl-C, SIGTERM or SIGHUP.

    Parameters
    ----------
    name
        Of :func:`emulated`.
    rig_file
        Where its rig file is written, see :func:`written_rig_file`.
    feedback
        Of the head.

    Returns
    -------
    int
        0, or 1 when a device ended by itself.

    Raises
    ------
    ValueError
        For a set-up that there is not, and for a rig file that cannot be written.
    """
    quit_ = threading.Event()
    with contextlib.ExitStack() as stack:
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            if number == signal.SIGHUP and signal.getsignal(number) == signal.SIG_IGN:
                continue  # as nohup leaves it
            before = signal.signal(number, lambda *_: quit_.set())
            stack.callback(signal.signal, number, before)
        rig = stack.enter_context(emulated(name, feedback))
        if rig_file is not None:
            stack.enter_context(written_rig_file(rig, Path(rig_file)))
        print(summary(rig, rig_file), flush=True)
        while (error := rig.error()) is None and not quit_.wait(LOOK_S):
            pass
    if error is not None:
        print(f"a device ended: {error!r}", flush=True)
        return 1
    print("the emulated rig is gone", flush=True)
    return 0


@contextlib.contextmanager
def written_rig_file(rig: EmulatedRig, file: Path) -> Iterator[None]:
    """The rig file of a running rig, for as long as the rig lives.

    It is removed at the end, unless somebody changed it. A file that was there before
    is never touched.

    Parameters
    ----------
    rig
        Started.
    file
        To be written.

    Raises
    ------
    ValueError
        Where it cannot be written.
    """
    text = json.dumps(rig.rig_file(), indent=1) + "\n"
    try:
        with file.open("x") as stream:
            stream.write(text)
    except FileExistsError:
        raise ValueError(
            f"{file}: exists already, and is not written over: name another file with --rig-file, "
            "or remove this one first"
        ) from None
    except OSError as error:
        file.unlink(missing_ok=True)
        raise ValueError(
            f"{file}: cannot be written ({error.strerror}): name another file, in a folder that "
            "exists and can be written, with --rig-file"
        ) from error
    try:
        yield
    finally:
        with contextlib.suppress(OSError):  # somebody removed it
            if file.read_bytes() == text.encode():
                file.unlink()
            else:
                print(f"{file}: was changed, so it stays; its devices are gone", flush=True)


def summary(rig: EmulatedRig, file: str | os.PathLike | None) -> str:
    """What other programs need to know of an emulated rig.

    Parameters
    ----------
    rig
        Started.
    file
        Its rig file.
    """
    head = rig.pan_tilt
    places = ", ".join(str(placement.number) for placement in rig.world.placements)
    lines = [
        f"emulated rig '{rig.setup.name}' ({rig.setup.rig.beam.name}); Ctrl-C ends it",
        f"  lrf      {rig.lrf.path}   {rig.lrf.baudrate} Bd, SICK LMS2xx",
        f"  head     {head.path}   {head.baudrate} Bd, Pelco-D, address {head.habits.address}",
        *(f"  {name:8s} {url}" for name, url in rig.camera_urls.items()),
        f"  board    curl -X POST {rig.camera_server.control}/place/NUMBER puts it at {places}, or "
        "none",
    ]
    if file is not None:
        lines.append(f"  rig file {file}   python -m lrfcal_lib record --help")
    return "\n".join(lines)
