"""What stands behind the ends of the board, as far as it decides where readings flip."""

from __future__ import annotations

import numpy as np

MIXING = 1.0  # metres; an LMS2xx gives one reading for two surfaces nearer together along the beam (telegram listing)


def beyond(scan, line, beam, down, right, beams=3):
    """Range of what stands behind ends of the board: the median of the next readings, inf where there is none.

    Parameters
    ----------
    scan : BoardScan
    line, beam : ndarray of int, shape (n,)
        The last cell on the board.
    down, right : ndarray of int, shape (n,)
        Step to the first cell off it, in scan lines and beams.
    beams : int
        Readings that count.

    Returns
    -------
    ndarray, shape (n,)
        Metres.
    """
    step, shape = np.arange(1, beams + 1), scan.mask.shape
    rows = np.clip(line[:, None] + down[:, None] * step, 0, shape[0] - 1)
    columns = np.clip(beam[:, None] + right[:, None] * step, 0, shape[1] - 1)
    return np.sort(np.nan_to_num(scan.sweep.ranges[rows, columns], nan=np.inf), axis=1)[:, beams // 2]


def background_odds(here, behind):
    """What the background adds to the log odds of the board's share of a spot at which readings flip.

    Parameters
    ----------
    here, behind : array_like
        Ranges of the board and of what stands behind it, metres.

    Returns
    -------
    ndarray
        ``2 ln(here / behind)``, the inverse square law; 0 where nothing is seen behind, or so close behind that both
        give one echo.
    """
    behind = np.asarray(behind, float)
    apart = np.isfinite(behind) & (behind - here >= MIXING)
    return 2 * np.log(np.where(apart, here / np.where(apart, behind, 1.0), 1.0))
