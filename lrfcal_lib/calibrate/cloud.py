"""Clouds of coloured points, and PLY files of them."""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from lrfcal_lib.session.write import whole

ABOUT = (  # every file
    "frame: platform (x = tilt axis, y ahead, z up at pitch 0)",
    "units: metres, radians; sigma in metres, image is the number of the image that counts most "
    "(-1: none)",
)
COLUMNS = {  # of a PLY file, of attributes that are no single float by the attribute's name
    "points": ("<f4", "x y z"),
    "normals": ("<f4", "nx ny nz"),
    "colors": ("u1", "red green blue"),
    "seen": ("u1", "seen"),
    "placement": ("<i4", "placement"),
    "image": ("<i4", "image"),
    "pitch": ("<f4", "pitch"),
    "bearing": ("<f4", "bearing"),
    "range": ("<f4", "range"),
    "intensity": ("<f4", "intensity"),
    "sigma": ("<f4", "sigma"),
}
KINDS = {"<f4": "float", "<i4": "int", "u1": "uchar"}  # NumPy's, in the words of PLY


@dataclass(frozen=True)
class Cloud:
    """Coloured points in the platform frame, a row each.

    Attributes
    ----------
    points, normals : ndarray, shape (n, 3)
        Metres; unit vectors towards the sensor, NaN where the surroundings are too small for one.
    colors : ndarray of uint8, shape (n, 3)
        Red, green, blue; grey where no camera sees the point.
    seen : ndarray of bool, shape (n,)
        Whether any camera sees the point.
    placement, image : ndarray of int, shape (n,)
        The sweep, and the number in `Session.image_records` of the image that counts most, -1 for
        none.
    pitch, bearing, range, intensity : ndarray, shape (n,)
        As measured (radians, radians, metres; NaN where no intensity was recorded).
    sigma : ndarray, shape (n,)
        Standard deviation across the surface, metres: scatter of the readings about it; see
        `features.with_sigma`.
    removed : int
        Mixed pixels that were left out.
    """

    points: np.ndarray
    normals: np.ndarray
    colors: np.ndarray
    seen: np.ndarray
    placement: np.ndarray
    image: np.ndarray
    pitch: np.ndarray
    bearing: np.ndarray
    range: np.ndarray
    intensity: np.ndarray
    sigma: np.ndarray
    removed: int = 0

    def __repr__(self):
        share = 100 * self.seen.mean() if len(self.seen) else 0.0
        return (
            f"Cloud({len(self.points)} points of {len(set(self.placement))} placements, "
            f"{share:.1f} % coloured)"
        )

    def rows(self, index: np.ndarray | slice) -> "Cloud":
        """Some of the points."""
        return replace(self, **{name: getattr(self, name)[index] for name in COLUMNS})


def join(clouds: Iterable[Cloud]) -> Cloud:
    """One cloud of several.

    Parameters
    ----------
    clouds : iterable of Cloud

    Returns
    -------
    Cloud
    """
    clouds = list(clouds)
    return Cloud(
        **{n: np.concatenate([getattr(cloud, n) for cloud in clouds]) for n in COLUMNS},
        removed=sum(cloud.removed for cloud in clouds),
    )


def point_type(columns: dict[str, tuple[str, str]]) -> np.dtype:
    """How a file with columns such as :data:`COLUMNS` holds one point."""
    return np.dtype(
        [(key, kind, (len(names.split()),)) for key, (kind, names) in columns.items()]
    )


def write_ply(
    path: str | Path, clouds: Iterable[Cloud], comments: Iterable[str] = ()
) -> int:
    """Write a cloud as binary PLY with all attributes; frame and units are comments.

    Parameters
    ----------
    path : path-like
    clouds : iterable of Cloud
        Blocks of the cloud as they come.
    comments : iterable of str
        For the head of the file.

    Returns
    -------
    int
        The number of points.

    Raises
    ------
    ValueError
        If the file cannot be written; it is whole, or as it was before.
    """
    properties = [
        f"property {KINDS[kind]} {name}"
        for kind, names in COLUMNS.values()
        for name in names.split()
    ]
    head = ["ply", "format binary_little_endian 1.0"]
    head += [f"comment {words}" for words in (*ABOUT, *comments)]

    def header(number):
        """The same length for every number of points."""
        lines = [*head, f"element vertex {number:<12d}", *properties, "end_header", ""]
        return "\n".join(lines).encode()

    count = 0
    with whole(path) as draft, open(draft, "wb") as file:
        file.write(header(0))
        for cloud in clouds:
            rows = np.empty(len(cloud.points), point_type(COLUMNS))
            for attribute in COLUMNS:
                rows[attribute] = getattr(cloud, attribute).reshape(len(rows), -1)
            file.write(rows.tobytes())
            count += len(rows)
        file.seek(0)
        file.write(header(count))
    return count
