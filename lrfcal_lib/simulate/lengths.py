"""True lengths in the simulated room, out of its geometry.

A row of ``lengths.json`` names two faces or two edges of boxes and rectangles of ``room.json``: its
part, the thing's number there and the sides: ``+z`` is the face towards z of the thing's own frame,
``+z-x`` the edge that it shares with the face towards -x. A rectangle lies in its plane z = 0: its
face is ``+z``, its edges are ``-x``, ``+x``, ``-y`` and ``+y``.
"""

import json
from pathlib import Path

import numpy as np

from lrfcal_lib.simulate.scene import ROOM, furnished, need
from lrfcal_lib.simulate.shapes import BOX_CORNERS

LENGTHS = json.loads(Path(__file__).with_name("lengths.json").read_text())
PARALLEL = 1e-9  # sine of the angle between the ends of a length


def room_lengths() -> list[dict]:
    """Lengths of the room as ``truth.json`` has them.

    Returns
    -------
    list of dict
        name, kind ('plane-plane' or 'edge-edge'), metres, and the two ends: the four corners of a
        face or the two of an edge, metres in the frame of ``room.json``.

    Raises
    ------
    ValueError
        If the two ends of a length are not parallel.
    """
    lengths = []
    for row in LENGTHS:
        ends = np.stack([_corners(*end) for end in row["ends"]])
        lengths.append(
            {
                "name": row["name"],
                "kind": row["kind"],
                "metres": _distance(row["name"], ends),
                "ends": ends.tolist(),
            }
        )
    return lengths


def _corners(part, number, sides):
    """The corners (4, 3) of a face or (2, 3) of an edge of a thing, in the room."""
    shape, *sizes = ROOM[part][number]["shape"]
    if shape == "box":
        sizes = sizes[0]
    else:
        need(shape == "rectangle", f"{part} {number} is a {shape}: it has no such faces")
    signs = BOX_CORNERS
    for sign, axis in zip(sides[::2], sides[1::2], strict=True):
        signs = signs[signs[:, "xyz".index(axis)] == int(f"{sign}1")]
    corners = signs * np.resize([*sizes, 0.0], 3) / 2
    return furnished(part)[number].pose.apply(np.unique(corners, axis=0))


def _distance(name, ends):
    """Between two parallel faces (2, 4, 3), or two parallel edges (2, 2, 3): metres."""
    faces = ends.shape[1] == 4
    middles = ends.mean(axis=1)
    axes = np.linalg.svd(ends - middles[:, None])[2]
    # the normals of faces, the directions of edges
    one, other = axes[:, 2 if faces else 0]
    tilted = np.linalg.norm(np.cross(one, other))
    need(tilted < PARALLEL, f"'{name}': its ends are not parallel")
    way = middles[1] - middles[0]
    along = way @ one
    if faces:
        return float(abs(along))
    return float(np.linalg.norm(way - along * one))
