"""What solvers take: of one camera and the LRF, and of a whole rig at once."""

from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np
from scipy.spatial.transform import RigidTransform

from lrfcal_lib.model.camera import CameraModel
from lrfcal_lib.model.geometry import DegenerateGeometry

Array = np.ndarray
ROUGH_NOISE = 1e-4 * np.eye(
    3
)  # a centimetre every way, for points whose covariance is not told
# observations that a pose takes at least, by kind
NEEDED = {
    "crossing": (6, "crossings of scan lines with edges"),
    "plane": (3, "placements with a board pose and points on the board"),
    "scene": (3, "scene points"),
}


def thin(rows: Any, count: int) -> Any:
    """At most `count` of some rows, evenly spread."""
    if len(rows) <= count:
        return rows
    return rows[np.linspace(0, len(rows) - 1, count).round().astype(int)]


def rows(group: str, *shape: int | str, default=0.0):
    """A field of arrays with a row for each member of a group, which is as long as its first field.

    In `shape` a group is its length. Where the field is not given, every row is the default; None:
    the row's number.
    """
    metadata = {"group": group, "shape": shape, "default": default}
    return field(default=None, metadata=metadata)


class _Grouped:
    """Arrays in groups of equal length; every field of :func:`rows` says which one is its."""

    def complete(self, whose="", **counts):
        """Give missing arrays their default, and refuse what is not finite; `counts` are lengths of
        groups that are known.
        """
        for f in fields(self):
            value = getattr(self, f.name)
            if f.metadata:
                group, shape, default = f.metadata.values()
                if value is None:
                    count = counts.get(group, 0)
                    value = np.arange(count)
                    if default is not None:
                        sizes = [counts.get(size, size) for size in shape]
                        value = np.full((count, *sizes), default)
                    object.__setattr__(self, f.name, value)
                counts.setdefault(group, value.shape[value.ndim - len(shape) - 1])
            if not isinstance(value, np.ndarray) or value.dtype.kind != "f":
                continue
            bad = ~np.isfinite(value)
            if bad.any() and f.name != "pattern_pixels":  # NaN where not seen
                row = np.argwhere(bad)[0, 0]
                raise ValueError(
                    f"{f.name}{whose} holds {bad.sum()} values that are not finite, the first in "
                    f"row {row} ({value[row].ravel()[:3]}): leave such observations out"
                )

    def keep(self, **masks):
        """The observations with some rows of groups left out, e.g. ``keep(view=mask)``."""
        changed = {}
        for f in fields(self):
            group = f.metadata.get("group")
            if group in masks:
                changed[f.name] = getattr(self, f.name)[masks[group]]
        return replace(self, **changed)


@dataclass(frozen=True)
class CameraObservations(_Grouped):
    """Paired observations of the board by the LRF and one camera, stacked over all placements.

    Points are in the *source* frame, the frame the camera is fixed to as seen from the LRF:
    ``platform`` for a camera on the base, ``lrf`` (at the pitch of the image) for a camera on the
    head. What a method estimates is ``T_camera_source``. What is not given is empty or has a
    default; many trials at once have a leading axis.

    Attributes
    ----------
    model : CameraModel
    camera, source : str
        Name of the camera, and ``'platform'`` or ``'lrf'``.
    crossing_points : ndarray, shape (n, 3)
        Where a scan line crosses an edge of the board (E and F of equation (17)), metres.
    crossing_covariance : ndarray, shape (n, 3, 3)
        A centimetre every way by default, as of the other points.
    crossing_lines : ndarray, shape (n, 3)
        The image line of that edge (ab and ac), undistorted pixels, unit normal pointing out of the
        board.
    crossing_line_sigma : ndarray, shape (n,)
        Standard deviation of the image line at the crossing, pixels; 0.5 by default.
    crossing_placement, crossing_edge : ndarray of int and of str, shape (n,)
        Every row has a placement of its own by default, as of the other groups.
    crossing_pitch, plane_pitch : ndarray, shapes (n,), (m,)
        Recorded pitch of the points, radians; only its errors (:mod:`lrfcal_lib.solvers.pitch`)
        need it.
    crossing_across : ndarray of bool, shape (n,)
        Where the edge was found across the scan lines (the sweep enters or leaves the board there):
        its place hangs on the recorded pitch. The paper uses none of these.
    crossing_radius, crossing_background : ndarray, shape (n,)
        Of the beam's spot there, metres (5 mm by default), and what the background adds to the log
        odds at which a reading flips from the board to it (see
        :mod:`lrfcal_lib.fit.edge_likelihood`).
    plane_points, plane_covariance, plane_placement : ndarray, shapes (m, 3), (m, 3, 3), (m,)
        Points on the face of the board, metres.
    placements : ndarray of int, shape (p,)
        Placements of which the camera knows the board's pose.
    board_poses : ndarray, shape (p, 4, 4)
        ``T_camera_board``.
    board_covariance : ndarray, shape (p, 6, 6)
        Of ``[w, v]`` of the poses (see :mod:`lrfcal_lib`); zeros (exact) by default.
    pattern_points, pattern_pixels : ndarray, shapes (k, 3), (p, k, 2)
        Corners of the printed pattern in the board frame, metres (k = 0 without a pattern), and
        their recorded pixels, NaN where not seen.
    pattern_sigma_px : float
        Standard deviation of one coordinate of a pattern corner.
    scene_points, scene_covariance : ndarray, shapes (q, 3) and (q, 3, 3)
        Points that LRF and camera can both name (outline corners: where fitted edges meet), metres.
    scene_pixels, scene_sigma_px, scene_placement : ndarray, shapes (q, 2), (q,), (q,)
        Undistorted pixels of the same points.

    Raises
    ------
    ValueError
        When an observation is not finite.

    Examples
    --------
    Six points on edges of a board, and the lines of these edges in the image of a camera 10 cm to
    the right:

    >>> import numpy as np
    >>> from lrfcal_lib.model.camera import CameraModel, line_through
    >>> from lrfcal_lib.model.observations import CameraObservations
    >>> from lrfcal_lib.solvers import solve_camera
    >>> model = CameraModel(640, 480, fx=500.0, fy=500.0, cx=320.0, cy=240.0)
    >>> ahead = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])  # R of T_camera_lrf
    >>> points = [[-1, 3, 0], [-0.6, 2, 0], [-0.1, 3, 0], [0.2, 2, 0], [0.7, 3, 0], [0.5, 2, 0]]
    >>> points = np.array(points, float)
    >>> seen = points @ ahead.T - [0.1, 0, 0]
    >>> pixels = seen[:, :2] / seen[:, 2:] * 500.0 + [320.0, 240.0]
    >>> turn = np.radians([80, 100, 35, 145, 60, 120])  # of the edges in the image
    >>> lines = line_through(pixels, pixels + np.stack([np.cos(turn), np.sin(turn)], axis=1))
    >>> obs = CameraObservations(model, crossing_points=points, crossing_lines=lines)
    >>> np.allclose(solve_camera(obs, "line").transform.translation, [-0.1, 0, 0])
    True
    """

    model: CameraModel
    camera: str = "camera"
    source: str = "lrf"
    crossing_points: Array = rows("crossing", 3)
    crossing_covariance: Array = rows("crossing", 3, 3, default=ROUGH_NOISE)
    crossing_lines: Array = rows("crossing", 3, default=np.nan)
    crossing_line_sigma: Array = rows("crossing", default=0.5)
    crossing_placement: Array = rows("crossing", default=None)
    crossing_edge: Array = rows("crossing", default="")
    crossing_pitch: Array = rows("crossing")
    crossing_across: Array = rows("crossing", default=False)
    crossing_radius: Array = rows("crossing", default=0.005)
    crossing_background: Array = rows("crossing")
    plane_points: Array = rows("plane", 3)
    plane_covariance: Array = rows("plane", 3, 3, default=ROUGH_NOISE)
    plane_placement: Array = rows("plane", default=None)
    plane_pitch: Array = rows("plane")
    board_poses: Array = rows("board", 4, 4)
    placements: Array = rows("board", default=None)
    board_covariance: Array = rows("board", 6, 6)
    pattern_points: Array = rows("pattern", 3)
    pattern_pixels: Array = rows("board", "pattern", 2, default=np.nan)
    pattern_sigma_px: float = 0.2
    scene_points: Array = rows("scene", 3)
    scene_covariance: Array = rows("scene", 3, 3, default=ROUGH_NOISE)
    scene_pixels: Array = rows("scene", 2, default=np.nan)
    scene_sigma_px: Array = rows("scene", default=0.5)
    scene_placement: Array = rows("scene", default=None)

    def __post_init__(self):
        self.complete(f" of camera '{self.camera}'")

    @property
    def all_placements(self):
        """Every placement that contributes anything, sorted."""
        return np.unique(
            np.r_[
                self.crossing_placement,
                self.plane_placement,
                self.placements,
                self.scene_placement,
            ]
        )

    def require(self, kind):
        """Refuse fewer than are `NEEDED` of a kind."""
        least, what = NEEDED[kind]
        placements = getattr(self, f"{kind}_placement")
        if kind == "plane":
            placements = np.intersect1d(self.placements, placements)
        if len(placements) < least:
            raise DegenerateGeometry(
                f"camera '{self.camera}': {len(placements)} of the {least} {what} that are needed "
                "at least: the rest of the pose stays unobservable"
            )

    def along(self):
        """Without the edges found across the scan lines: what the paper works on."""
        return self.keep(crossing=~self.crossing_across)

    def select(self, placements):
        """The observations of some placements (numbers) only."""
        wanted = list(placements)
        return self.keep(
            crossing=np.isin(self.crossing_placement, wanted),
            plane=np.isin(self.plane_placement, wanted),
            scene=np.isin(self.scene_placement, wanted),
            board=np.isin(self.placements, wanted),
        )


@dataclass(frozen=True, kw_only=True)
class PlatformObservations(_Grouped):
    """Edge points and face points of boards swept by the pitching LRF.

    Attributes
    ----------
    edge_points, face_points : ndarray, shapes (n, 3), (m, 3)
        LRF frame, metres; those of faces may be missing.
    edge_covariance, face_covariance : ndarray, shapes (n, 3, 3), (m, 3, 3)
    edge_pitch, face_pitch : ndarray, shapes (n,), (m,)
        Recorded pitch of their scan lines, radians.
    edge_placement, face_placement : ndarray of int, shapes (n,), (m,)
    edge_number : ndarray of int, shape (n,)
        1 or 2: the two perpendicular edges of equations (7) to (14).
    """

    edge_points: Array = rows("edge", 3)
    edge_covariance: Array = rows("edge", 3, 3)
    edge_pitch: Array = rows("edge")
    edge_placement: Array = rows("edge", default=0)
    edge_number: Array = rows("edge", default=1)
    face_points: Array = rows("face", 3)
    face_covariance: Array = rows("face", 3, 3)
    face_pitch: Array = rows("face")
    face_placement: Array = rows("face", default=0)

    def __post_init__(self):
        self.complete()
        if not np.isin(self.edge_number, (1, 2)).all():
            raise ValueError(
                "edge_number must be 1 or 2 (the two perpendicular edges), got "
                f"{np.unique(self.edge_number)}"
            )


@dataclass(frozen=True, kw_only=True)
class JointObservations(_Grouped):
    """Ranges on boards, beams about their edges and board poses in images, of all placements.

    Every group has an array `<group>_placement` of indices into `placements`. Any group may be
    empty.

    Attributes
    ----------
    placements : ndarray of int, shape (p,)
        Numbers of the placements.
    direction : ndarray of int, shape (p,)
        Sweep direction, +1 or -1; 0 for a single shot, and by default.
    middle : ndarray, shape (p,)
        Pitch about which a sweep may be stretched, radians.
    face_range, face_bearing, face_pitch, face_sigma : ndarray, shape (m,)
        Ranges measured on the board's face (metres), their bearings and recorded pitch (radians),
        and standard deviations (metres).
    face_placement : ndarray of int, shape (m,)
    beam_bearing, beam_pitch, beam_hit, beam_edge : ndarray, shape (n,)
        Of beams near an edge: radians, whether the beam read the board, index into `edges`.
    beam_radius, beam_background, beam_step : ndarray, shape (n,)
        Of the spot at the board, metres; see :mod:`lrfcal_lib.fit.edge_likelihood`; distance at the
        board to the next beam in the direction in which the edge was found, metres.
    beam_placement : ndarray of int, shape (n,)
    view_camera, view_pitch : ndarray, shape (v,)
        Index into `cameras`, and recorded pitch at the image, radians; only used for cameras on the
        head.
    view_pose : ndarray, shape (v, 4, 4)
        ``T_camera_board`` from the pattern's corners and the board's edges in the image.
    view_covariance : ndarray, shape (v, 6, 6)
        Of its increments ``[w, v]``.
    view_placement : ndarray of int, shape (v,)
    edges : tuple of str
    corners : ndarray, shape (e, 2)
        Outline of the board, metres.
    cameras, mounts : tuple of str
        Names, and 'head' or 'platform'.
    T_head_lrf : RigidTransform or None
        Stated platform: one of the start values, and the rotation about the axis and shift along it
        that no data show.
    view_lens : ndarray, shape (v, 6, 9), optional
        Derivative of the view's pose by the intrinsics. Zeros by default.
    lens_covariance : ndarray, shape (c, 9, 9), optional
        Of the intrinsics of every camera. Zeros (exactly known) by default.
    """

    placements: Array = rows("placement", default=None)
    direction: Array = rows("placement", default=0)
    middle: Array = rows("placement")
    face_range: Array = rows("face")
    face_bearing: Array = rows("face")
    face_pitch: Array = rows("face")
    face_sigma: Array = rows("face")
    face_placement: Array = rows("face", default=0)
    beam_bearing: Array = rows("beam")
    beam_pitch: Array = rows("beam")
    beam_hit: Array = rows("beam", default=False)
    beam_edge: Array = rows("beam", default=0)
    beam_radius: Array = rows("beam")
    beam_background: Array = rows("beam")
    beam_step: Array = rows("beam")
    beam_placement: Array = rows("beam", default=0)
    view_pose: Array = rows("view", 4, 4)
    view_camera: Array = rows("view", default=0)
    view_pitch: Array = rows("view")
    view_covariance: Array = rows("view", 6, 6)
    view_placement: Array = rows("view", default=0)
    edges: tuple
    corners: Array
    cameras: tuple
    mounts: tuple
    T_head_lrf: RigidTransform | None = None
    view_lens: Array = rows("view", 6, 9)
    lens_covariance: Array = rows("camera", 9, 9)

    def __post_init__(self):
        self.complete(camera=len(self.cameras))
        count = len(self.placements)
        for name in ("face_placement", "beam_placement", "view_placement"):
            place = getattr(self, name)
            if not np.isin(place, np.arange(count)).all():
                raise ValueError(
                    f"{name} are indices below {count}, got up to {place.max()}"
                )
        if np.any(self.face_sigma <= 0):
            raise ValueError(f"face_sigma must be positive, got {self.face_sigma.min()}")

    @property
    def on_head(self) -> Array:
        """Which cameras are fixed to the head, bool (c,)."""
        return np.isin(self.mounts, "head")

    @property
    def count(self) -> int:
        """Number of ranges, beams and views together."""
        return len(self.face_range) + len(self.beam_hit) + len(self.view_pitch)

    def select(self, placements):
        """The observations of some placements (numbers) only."""
        kept = np.flatnonzero(np.isin(self.placements, list(placements)))
        out = self.keep(
            face=np.isin(self.face_placement, kept),
            beam=np.isin(self.beam_placement, kept),
            view=np.isin(self.view_placement, kept),
        )
        numbered = replace(
            out,
            face_placement=np.searchsorted(kept, out.face_placement),
            beam_placement=np.searchsorted(kept, out.beam_placement),
            view_placement=np.searchsorted(kept, out.view_placement),
        )
        return numbered.keep(placement=kept)

    def stretched(self, share: float):
        """The observations with bearings stretched by a share about the middle one, pi / 2."""
        return replace(
            self,
            face_bearing=self.face_bearing + share * (self.face_bearing - np.pi / 2),
            beam_bearing=self.beam_bearing + share * (self.beam_bearing - np.pi / 2),
        )

    def with_cameras(self, names):
        """The observations of some cameras only."""
        kept = [i for i, name in enumerate(self.cameras) if name in names]
        out = self.keep(view=np.isin(self.view_camera, kept), camera=kept)
        return replace(
            out,
            view_camera=np.searchsorted(kept, out.view_camera),
            cameras=tuple(self.cameras[i] for i in kept),
            mounts=tuple(self.mounts[i] for i in kept),
        )
