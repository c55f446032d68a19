"""How alike pictures are."""

import numpy as np


def psnr(one, other) -> np.ndarray:
    """Peak signal-to-noise ratio of pictures [..., height, width, 3] in decibel."""
    error = np.square(np.asarray(one, np.float64) - np.asarray(other)).mean((-3, -2, -1))
    return 10 * np.log10(255**2 / np.maximum(error, 1e-9))
