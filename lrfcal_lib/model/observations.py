"""What solvers take: of one camera and the LRF, and of a whole rig at once."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np
from scipy.spatial.transform import RigidTransform

from lrfcal_lib.model.board import outline_lines
from lrfcal_lib.model.camera import CameraModel


@dataclass(frozen=True)
class CameraObservations:
    """Paired observations of the board by the LRF and one camera, stacked over all placements.

    Points are in the *source* frame, the frame the camera is fixed to as seen from the LRF: ``platform`` for a camera
    on the base, ``lrf`` (at the pitch of the image) for a camera on the head. What a method estimates is
    ``T_camera_source``.

    Attributes
    ----------
    camera, source : str
        Name of the camera, and ``'platform'`` or ``'lrf'``.
    model : CameraModel
    crossing_points : ndarray, shape (n, 3)
        Where a scan line crosses an edge of the board (E and F of equation (17)), metres.
    crossing_covariance : ndarray, shape (n, 3, 3)
    crossing_lines : ndarray, shape (n, 3)
        The image line of that edge (ab and ac), undistorted pixels, unit normal pointing out of the board.
    crossing_line_sigma : ndarray, shape (n,)
        Standard deviation of the image line at the crossing, pixels.
    crossing_placement : ndarray of int, shape (n,)
    crossing_edge : ndarray of str, shape (n,)
    crossing_across : ndarray of bool, shape (n,)
        Where the edge was found across the scan lines (the sweep enters or leaves the board there): its place hangs on
        the recorded pitch. The paper uses none of these.
    crossing_half_step : ndarray, shape (n, 3)
        From halfway between the last beam on the board and the first off it to the latter, metres.
    crossing_noise : ndarray, shape (n, 3, 3)
        The covariance without the beam spacing.
    crossing_radius : ndarray, shape (n,)
        Of the beam's spot there, metres.
    crossing_background : ndarray, shape (n,)
        What the background adds to the log odds at which a reading flips from the board to it (see
        :mod:`lrfcal_lib.fit.residuals`).
    plane_points : ndarray, shape (m, 3)
        Points on the face of the board, metres.
    plane_covariance : ndarray, shape (m, 3, 3)
    plane_placement : ndarray of int, shape (m,)
    placements : ndarray of int, shape (p,)
        Placements of which the camera knows the board's pose.
    board_poses : ndarray, shape (p, 4, 4)
        ``T_camera_board``.
    board_covariance : ndarray, shape (p, 6, 6)
        Of ``[w, v]`` of the poses (see :mod:`lrfcal_lib`).
    pattern_points : ndarray, shape (k, 3)
        Corners of the printed pattern in the board frame, metres; k = 0 without a pattern.
    pattern_pixels : ndarray, shape (p, k, 2)
        Their recorded pixels, NaN where not seen.
    pattern_sigma_px : float
        Standard deviation of one coordinate of a pattern corner.
    scene_points : ndarray, shape (q, 3)
        Points that LRF and camera can both name (outline corners: where fitted edges meet), metres.
    scene_covariance : ndarray, shape (q, 3, 3)
    scene_pixels : ndarray, shape (q, 2)
        Undistorted pixels of the same points.
    scene_sigma_px : ndarray, shape (q,)
    scene_placement : ndarray of int, shape (q,)
    """

    camera: str
    source: str
    model: CameraModel
    crossing_points: np.ndarray
    crossing_covariance: np.ndarray
    crossing_lines: np.ndarray
    crossing_line_sigma: np.ndarray
    crossing_placement: np.ndarray
    crossing_edge: np.ndarray
    crossing_across: np.ndarray
    crossing_half_step: np.ndarray
    crossing_noise: np.ndarray
    crossing_radius: np.ndarray
    crossing_background: np.ndarray
    plane_points: np.ndarray
    plane_covariance: np.ndarray
    plane_placement: np.ndarray
    placements: np.ndarray
    board_poses: np.ndarray
    board_covariance: np.ndarray
    pattern_points: np.ndarray
    pattern_pixels: np.ndarray
    pattern_sigma_px: float
    scene_points: np.ndarray
    scene_covariance: np.ndarray
    scene_pixels: np.ndarray
    scene_sigma_px: np.ndarray
    scene_placement: np.ndarray

    @property
    def all_placements(self):
        """Every placement that contributes anything, sorted."""
        parts = (self.crossing_placement, self.plane_placement, self.placements, self.scene_placement)
        return np.unique(np.concatenate(parts))

    def along(self):
        """Without the edges found across the scan lines: what the paper works on."""
        keep = ~self.crossing_across
        names = [f.name for f in fields(self) if f.name.startswith("crossing_")]
        return replace(self, **{name: getattr(self, name)[keep] for name in names})

    def select(self, placements):
        """The observations of some placements only (for leave-one-out and random halves).

        Parameters
        ----------
        placements : iterable of int

        Returns
        -------
        CameraObservations
        """
        wanted = np.asarray(list(placements))
        groups = {
            "crossing_": np.isin(self.crossing_placement, wanted),
            "plane_": np.isin(self.plane_placement, wanted),
            "scene_": np.isin(self.scene_placement, wanted),
        }
        changed = {
            f.name: getattr(self, f.name)[keep]
            for f in fields(self)
            for prefix, keep in groups.items()
            if f.name.startswith(prefix)
        }
        keep = np.isin(self.placements, wanted)
        for name in ("placements", "board_poses", "board_covariance", "pattern_pixels"):
            changed[name] = getattr(self, name)[keep]
        return replace(self, **changed)


GROUPS = ("face", "beam", "view")


@dataclass(frozen=True)
class JointObservations:
    """Ranges on boards, beams about their edges and board poses in images, of all placements.

    Every group has an array `<group>_placement` of indices into `placements`. Any group may be empty.

    Attributes
    ----------
    placements : ndarray of int, shape (p,)
        Numbers of the placements.
    direction : ndarray of int, shape (p,)
        Sweep direction, +1 or -1; 0 for a single shot.
    middle : ndarray, shape (p,)
        Pitch about which a sweep may be stretched, radians.
    face_range, face_bearing, face_pitch, face_sigma : ndarray, shape (m,)
        Ranges measured on the board's face (metres), their bearings and recorded pitch (radians), and standard
        deviations (metres).
    face_placement : ndarray of int, shape (m,)
    beam_bearing, beam_pitch : ndarray, shape (n,)
        Of beams near an edge, radians.
    beam_hit : ndarray of bool, shape (n,)
        Whether the beam read the board.
    beam_edge : ndarray of int, shape (n,)
        Index into `edges`.
    beam_radius : ndarray, shape (n,)
        Of the spot at the board, metres.
    beam_background : ndarray, shape (n,)
        See :mod:`lrfcal_lib.fit.residuals`.
    beam_step : ndarray, shape (n,)
        Distance at the board to the next beam in the direction in which the edge was found, metres.
    beam_placement : ndarray of int, shape (n,)
    view_camera : ndarray of int, shape (v,)
        Index into `cameras`.
    view_pitch : ndarray, shape (v,)
        Recorded pitch at the image, radians; only used for cameras on the head.
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
        Stated platform: one of the start values, and the rotation about the axis and shift along it that no data show.
    view_lens : ndarray, shape (v, 6, 9), optional
        Derivative of the view's pose by the intrinsics; see :mod:`lrfcal_lib.solvers.joint_noise`. Zeros by default.
    lens_covariance : ndarray, shape (c, 9, 9), optional
        Of the intrinsics of every camera. Zeros (exactly known) by default.
    """

    placements: np.ndarray
    direction: np.ndarray
    middle: np.ndarray
    face_range: np.ndarray
    face_bearing: np.ndarray
    face_pitch: np.ndarray
    face_sigma: np.ndarray
    face_placement: np.ndarray
    beam_bearing: np.ndarray
    beam_pitch: np.ndarray
    beam_hit: np.ndarray
    beam_edge: np.ndarray
    beam_radius: np.ndarray
    beam_background: np.ndarray
    beam_step: np.ndarray
    beam_placement: np.ndarray
    view_camera: np.ndarray
    view_pitch: np.ndarray
    view_pose: np.ndarray
    view_covariance: np.ndarray
    view_placement: np.ndarray
    edges: tuple
    corners: np.ndarray
    cameras: tuple
    mounts: tuple
    T_head_lrf: RigidTransform | None = None
    view_lens: np.ndarray | None = None
    lens_covariance: np.ndarray | None = None

    def __post_init__(self):
        if self.view_lens is None:
            object.__setattr__(self, "view_lens", np.zeros((len(self.view_camera), 6, 9)))
        if self.lens_covariance is None:
            object.__setattr__(self, "lens_covariance", np.zeros((len(self.cameras), 9, 9)))
        for field in fields(self):
            value = getattr(self, field.name)
            if isinstance(value, np.ndarray) and value.dtype.kind == "f" and not np.isfinite(value).all():
                bad = int((~np.isfinite(value)).sum())
                raise ValueError(f"{field.name} holds {bad} values that are not finite: leave such observations out")
        for group in GROUPS:
            place = getattr(self, f"{group}_placement")
            if len(place) and not 0 <= place.min() <= place.max() < len(self.placements):
                raise ValueError(f"{group}_placement are indices below {len(self.placements)}, got up to {place.max()}")
        if len(self.face_sigma) and self.face_sigma.min() <= 0:
            raise ValueError(f"face_sigma must be positive, got {self.face_sigma.min()}")

    def lines(self):
        """Sides of the board, see :meth:`lrfcal_lib.model.board.Board.lines`."""
        return outline_lines(self.corners)

    def group(self, name):
        """Fields of one group of observations: dict of arrays without the group's prefix."""
        return {f.name[len(name) + 1 :]: getattr(self, f.name) for f in fields(self) if f.name.startswith(name + "_")}

    def keep(self, **masks):
        """The observations with some rows of groups left out, e.g. ``keep(view=mask)``."""
        changed = {}
        for name, mask in masks.items():
            changed |= {f"{name}_{key}": value[mask] for key, value in self.group(name).items()}
        return replace(self, **changed)

    def select(self, placements):
        """The observations of some placements only (for leave-one-out and random halves).

        Parameters
        ----------
        placements : iterable of int
            Numbers of placements.

        Returns
        -------
        JointObservations
        """
        kept = np.flatnonzero(np.isin(self.placements, np.asarray(list(placements))))
        new = np.full(len(self.placements), -1)
        new[kept] = np.arange(len(kept))
        rows = {name: new[getattr(self, f"{name}_placement")] >= 0 for name in GROUPS}
        out = self.keep(**rows)
        moved = {f"{name}_placement": new[getattr(out, f"{name}_placement")] for name in GROUPS}
        cut = {key: getattr(self, key)[kept] for key in ("placements", "direction", "middle")}
        return replace(out, **moved, **cut)

    def with_cameras(self, names):
        """The observations of some cameras only."""
        kept = [i for i, name in enumerate(self.cameras) if name in names]
        out = self.keep(view=np.isin(self.view_camera, kept))
        camera = np.searchsorted(kept, out.view_camera) if kept else out.view_camera
        chosen = {key: tuple(getattr(self, key)[i] for i in kept) for key in ("cameras", "mounts")}
        chosen["lens_covariance"] = self.lens_covariance[kept]
        return replace(out, view_camera=camera, **chosen)
