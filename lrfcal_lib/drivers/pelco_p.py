"""Pelco-P: the commands of Pelco-D in frames of 8 bytes, as older receivers want them.

::

    0xA0  address  command 1  command 2  data 1  data 2  0xAF  XOR of the 7 bytes before

The replies to position queries have the same frame and Pelco-D's opcodes. Source: Pelco C466M-E.
"""

from __future__ import annotations

from lrfcal_lib.drivers.pelco_d import Frame, FrameError, pack_bytes

START, END, ACKNOWLEDGE = 0xA0, 0xAF, 0xA2


def encode_frame(address, command1=0, command2=0, data1=0, data2=0):
    """Bytes of a Pelco-P frame: the same commands, addresses from 0, a checksum that is the XOR of all other bytes.

    Parameters
    ----------
    address : int
        0 is the first receiver, up to 31.
    command1, command2, data1, data2 : int

    Returns
    -------
    bytes, length 8

    Raises
    ------
    FrameError
        For numbers that are no bytes, or an address above 31.
    """
    if not 0 <= address <= 0x1F:
        raise FrameError(f"Pelco-P addresses are 0 to 31, one less than Pelco-D's, got {address}")
    body = pack_bytes(address=address, command1=command1, command2=command2, data1=data1, data2=data2)
    raw = bytes([START]) + body + bytes([END])
    return raw + bytes([_xor(raw)])


def parse_frame(raw):
    """Take start, end and checksum off one Pelco-P frame.

    Parameters
    ----------
    raw : bytes-like, length 8

    Returns
    -------
    Frame

    Raises
    ------
    FrameError
        If length, start, end or checksum is wrong.
    """
    raw = bytes(raw)
    if len(raw) != 8 or raw[0] != START or raw[6] != END:
        raise FrameError(f"a Pelco-P frame is A0, 5 bytes, AF and a checksum, got {raw[:9].hex(' ') or 'none'}")
    if raw[7] != _xor(raw[:7]):
        raise FrameError(f"checksum {raw[7]:02X} sent, {_xor(raw[:7]):02X} computed: damaged on the line")
    return Frame(*raw[1:6])


def _xor(raw):
    value = 0
    for byte in raw:
        value ^= byte
    return value
