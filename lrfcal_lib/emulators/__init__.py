"""Devices that are not there: LMS2xx and Pelco-D heads on pseudo-terminals, cameras over HTTP, one simulated world.

With ``Clock(machine=VirtualHost())`` a device lives in virtual time instead, for tests of drivers (`drivers.host`).
"""



def __getattr__(name):
    """The whole rig only when it is asked for: its world needs Open3D, the serial devices do not."""
    if name == "EmulatedRig":
        from lrfcal_lib.emulators.rig import EmulatedRig

        return EmulatedRig
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
