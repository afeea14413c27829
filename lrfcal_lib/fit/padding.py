"""Rows of placements as padded rectangles, and rows of one thing as rows of all. No equations."""

import numpy as np


def medians(values: np.ndarray, used: np.ndarray) -> np.ndarray:
    """Medians of the used values of every row; many times as fast as np.nanmedian.

    Parameters
    ----------
    values : ndarray, shape (..., n)
    used : ndarray of bool, shape (..., n)

    Returns
    -------
    ndarray, shape (...)
        0 where there are none.
    """
    count = used.sum(axis=-1, keepdims=True)
    # one more, so that there is always something to take
    ordered = np.sort(
        np.insert(np.where(used, values, np.inf), 0, np.inf, axis=-1), axis=-1
    )
    middle = np.concatenate([count - 1, count], axis=-1) // 2
    median = np.take_along_axis(ordered, middle, axis=-1).mean(axis=-1)
    return np.where(count[..., 0] > 0, median, 0.0)


def pad(
    placement: np.ndarray, count: int, width: int = 1, **columns: np.ndarray
) -> dict[str, np.ndarray]:
    """Arrays sorted by placement into rectangles, zeros behind the rows of each.

    Parameters
    ----------
    placement : ndarray of int, shape (m,)
        Indices below `count` of the rows; -1 leaves a row out.
    count : int
        Number of placements.
    width : int
        Of the rectangles, at least.
    **columns : ndarray, shapes (m, ...)

    Returns
    -------
    dict of str to ndarray, shapes (count, n, ...)
        The columns; `used` marks what is no padding. Rows of a placement keep their order.
    """
    order = np.argsort(placement, kind="stable")[np.sum(placement < 0) :]
    number = np.bincount(placement[order], minlength=count)
    used = np.arange(number.max(initial=width)) < number[:, None]
    out = {"used": used}
    for key, value in columns.items():
        out[key] = np.zeros(used.shape + value.shape[1:], value.dtype)
        out[key][used] = value[order]
    return out


def among(by_one: np.ndarray, index: np.ndarray, count: int) -> np.ndarray:
    """Jacobian rows by the unknowns of one thing, such as a camera, as rows by those of all.

    Parameters
    ----------
    by_one : ndarray, shape (..., k)
    index : ndarray of int, broadcastable to (...)
        Which thing that is.
    count : int

    Returns
    -------
    ndarray, shape (..., count k)
    """
    mine = index[..., None] == np.arange(count)
    among_all = by_one[..., None, :] * mine[..., None]
    return among_all.reshape(*by_one.shape[:-1], -1)
