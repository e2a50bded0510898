"""Which values part what is around an object, the object, and what is dense in it?"""

import numpy as np
from jaxtyping import Float


BINS = 256


def thresholds(values: Float[np.ndarray, " n"]) -> tuple[float, float]:
    """Otsu's two thresholds. Between classes that are far apart any threshold is as good: the middle of their
    means is taken, where the border between them lies in a scan."""
    from skimage.filters import threshold_multiotsu

    low, high = (float(end) for end in np.percentile(values, (0, 99.9)))
    high = high if high > low else float(values.max())
    kept = np.clip(values, low, high)
    try:
        first, second = threshold_multiotsu(kept, 3, nbins=BINS)
    except ValueError:  # of fewer than three values
        first, second = low + (high - low) / 3, low + 2 * (high - low) / 3
    for _ in range(3):  # strays at the edge of a class join the nearer one
        classes = [kept[kept <= first], kept[(kept > first) & (kept <= second)], kept[kept > second]]
        if min(map(len, classes)) == 0:
            break
        means = [float(each.mean(dtype=np.float64)) for each in classes]
        first, second = (means[0] + means[1]) / 2, (means[1] + means[2]) / 2
    return float(first), float(second)
