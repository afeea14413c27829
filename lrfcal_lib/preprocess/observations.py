"""What one camera and the LRF saw of the board: the one thing every calibration method takes."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np

from lrfcal_lib.camera import CameraModel


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
        :mod:`lrfcal_lib.solvers.edge_likelihood`).
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
