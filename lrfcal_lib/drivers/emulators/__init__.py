"""Devices that are not there: LMS2xx and Pelco-D heads on pseudo-terminals, cameras over HTTP, one simulated world."""

from lrfcal_lib.drivers.emulators.faults import FAULTS, Faults
from lrfcal_lib.drivers.emulators.lms2xx import EmulatedLms
from lrfcal_lib.drivers.emulators.lms2xx_scans import ScanRecord, SyntheticSource
from lrfcal_lib.drivers.emulators.motion import Head
from lrfcal_lib.drivers.emulators.pelco_d import EmulatedHead

__all__ = ["FAULTS", "EmulatedHead", "EmulatedLms", "EmulatedRig", "Faults", "Head", "ScanRecord", "SyntheticSource"]


def __getattr__(name):
    """The whole rig only when it is asked for: its world needs Open3D, the serial devices do not."""
    if name == "EmulatedRig":
        from lrfcal_lib.drivers.emulators.rig import EmulatedRig

        return EmulatedRig
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
