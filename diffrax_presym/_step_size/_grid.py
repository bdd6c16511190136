import numpy as np


def intervals(ts: np.ndarray, t0: float, t1: float) -> int | None:
    """The number of equal intervals of the span at whose ends all times lie.

    `None` if there is none, or only one that is much finer than the times, as for 0.3
    and 7.7: the times are irregular.
    """
    start, span = np.float64(t0), np.float64(t1) - np.float64(t0)
    where = np.sort((np.asarray(ts, float) - start) / span)
    # Times are rounded, in their own precision.
    size = max(abs(float(t0)), abs(float(t1))) / abs(span)
    rounding = 4 * np.finfo(ts.dtype).eps * max(size, 1)
    gaps = np.diff(np.concatenate([[0.0], where, [1.0]]))
    gaps = gaps[gaps > rounding]
    if not gaps.size:
        return None
    # The mean of all that are equal, to average out the rounding.
    shortest = np.mean(gaps[gaps < 1.1 * np.min(gaps)])
    # The spacing may be a multiple of that of the grid, as for times half-way between
    # its points.
    for multiple in (1, 2, 3, 4):
        number = round(multiple / shortest)
        if number > 4 * (ts.size + 1):
            return None
        tolerance = rounding * number
        at = where * number
        if tolerance < 0.01 and np.all(np.abs(at - np.round(at)) <= tolerance):
            return number
    return None
