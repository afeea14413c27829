"""The scan lines of a session: its arrays, read and checked."""

import math
from collections.abc import Mapping
from io import BytesIO
from zipfile import ZIP_DEFLATED, ZIP_STORED, ZipFile

import numpy as np
from numpy.lib import format as npy
from numpy.typing import ArrayLike

from lrfcal_lib.session.files import (
    SessionError,
    check_amount,
    checked,
    naming,
    read_bytes,
    reading,
    short,
)
from lrfcal_lib.session.stated import MILLIMETRES

ARRAYS = ("ranges", "bearings", "placement", "pitch", "time_s", "intensities")
ENTRY = b"PK\1\2"  # begins each line of an archive's table of contents
MOST_ENTRIES = 100  # of an archive; a session's has the six arrays
# as numpy packs; bzip2 and LZMA are not unpacked in steps
PACKED = (ZIP_STORED, ZIP_DEFLATED)
# bytes before the values of an array; numpy refuses more, once it has them
LONGEST_HEADER = 10_000
# metres; no pitching 2D scanner sees half of its scene farther away than that
LONGEST_MEDIAN_RANGE = 200.0


def scanned(scans: Mapping[str, np.ndarray]) -> set[int]:
    """Numbers of the placements that scan lines with a range belong to.

    Parameters
    ----------
    scans
        As of :func:`check_scans`.
    """
    return set(scans["placement"][np.isfinite(scans["ranges"]).any(axis=1)].tolist())


def parts_of(path):
    """Files of a session's sweeps in their order, until it is finished."""
    return sorted(checked(path / "lrf", path).glob("part_*.npz"))


def read_npz(file, within):
    """The arrays of a scans.npz (or of one part of it), checked by :func:`check_scans`; no other is
    unpacked.
    """
    content = read_bytes(file, within)
    entries = content.count(ENTRY)
    if entries > MOST_ENTRIES:  # ZipFile would make objects of all
        raise SessionError(
            f"{file}: holds {entries} files, more than {MOST_ENTRIES}; write it again with the "
            f"arrays {short(ARRAYS)} only"
        )
    with (
        reading(file, "cannot be read ({}); truncated?"),
        ZipFile(BytesIO(content)) as archive,
    ):
        scans = _read_arrays(file, archive)
    with naming(file):
        return check_scans(scans)


def _read_arrays(file, archive):
    """The arrays that a session may have, each checked by its header before it is unpacked."""
    scans = {}
    values = 0
    for key in ARRAYS:
        name = f"{key}.npy"
        if name not in archive.namelist():
            continue
        if archive.getinfo(name).compress_type not in PACKED:
            raise SessionError(
                f"{file}: {key} is packed in another way than numpy does; write it again with "
                "numpy.savez_compressed"
            )
        with archive.open(name) as member:
            beginning = BytesIO(member.read(LONGEST_HEADER))
        header = npy.read_array_header_1_0
        if npy.read_magic(beginning) != (1, 0):
            header = npy.read_array_header_2_0
        shape, _, kind = header(beginning)
        if kind.kind not in "fiub" or kind.itemsize > 8:
            raise SessionError(
                f"{file}: {key} cannot be read: it holds {kind}, not numbers; write it without "
                "pickles"
            )
        values += abs(math.prod(shape))
        with naming(file):
            check_amount(values)
        with archive.open(name) as member:
            scans[key] = npy.read_array(member, allow_pickle=False)
    return scans


def check_scans(scans: Mapping[str, ArrayLike]) -> dict[str, np.ndarray]:
    """Scan lines with consistent shapes and credible units.

    Parameters
    ----------
    scans
        By name: ranges (N, B), metres; bearings (B,) and pitch (N,), radians; placement (N,);
        time_s (N,); intensities (N, B), or None.

    Returns
    -------
    dict of ndarray
        The same as floats (placement: integers), zero or infinite ranges NaN.

    Raises
    ------
    KeyError, ValueError
        For a missing array, wrong shapes or units, bearings that do not ascend, no range at all.
    """
    ranges = np.asarray(scans["ranges"], float)
    if ranges.ndim != 2:
        raise ValueError(f"ranges must be scan lines x beams, got shape {ranges.shape}")
    lines, beams = ranges.shape
    shapes = {
        "bearings": (beams,),
        "placement": (lines,),
        "pitch": (lines,),
        "time_s": (lines,),
    }
    if scans.get("intensities") is not None:
        shapes["intensities"] = ranges.shape
    checked = {"ranges": ranges}
    for key, shape in shapes.items():
        values = np.asarray(scans[key], int if key == "placement" else float)
        if values.shape != shape:
            raise ValueError(
                f"{key} has shape {values.shape}, the ranges {ranges.shape} ask for {shape}"
            )
        checked[key] = values
    seen = ranges[np.isfinite(ranges)]
    if not seen.size:
        raise ValueError(f"no range in {lines} scan lines (all NaN): nothing was recorded")
    if np.median(seen) > LONGEST_MEDIAN_RANGE:
        raise ValueError(f"the median range is {np.median(seen):g} m: {MILLIMETRES}")
    if seen.min() < 0:
        raise ValueError(
            f"a range is {seen.min():g} m: negative ranges are no measurements, use NaN"
        )
    _check_angles("bearing", checked["bearings"], 2 * np.pi)
    _check_angles("pitch", checked["pitch"], np.pi)
    if np.any(np.diff(checked["bearings"]) <= 0):
        raise ValueError(
            "bearings must ascend (0 right, pi/2 ahead): turn the columns of the ranges round"
        )
    ranges[(ranges == 0) | np.isinf(ranges)] = np.nan
    return checked


def _check_angles(name, angles, limit):
    """A ValueError where an angle is not finite, or too large to be in radians."""
    endless = np.sum(~np.isfinite(angles))
    if endless:
        raise ValueError(f"{endless} values of {name} are not finite")
    largest = np.abs(angles).max()
    if largest > limit + 1e-6:
        raise ValueError(f"a {name} is {largest:g} rad: degrees? Convert to radians")
