"""What can go wrong with a device: one base class, one subclass for every remedy."""


class DeviceError(RuntimeError):
    """Any failure of a device or of the line to it."""


class PortError(DeviceError):
    """The port cannot be opened or set: missing, no permission, busy, no serial line, rate not possible."""


class NoReply(DeviceError):
    """Nothing sensible arrived before the deadline."""


class WrongDevice(DeviceError):
    """Something answers, but not the device that was expected."""


class Refused(DeviceError):
    """The device understood and declined."""


class LineLost(DeviceError):
    """The port vanished; it can come back."""


class OutOfRange(DeviceError, ValueError):
    """A device was asked for more than it can do, such as a pitch beyond the limits of its head."""
