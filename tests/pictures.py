"""What a browser's page looks like, for tests that look at it."""

import io

import numpy as np


def pixels(page):
    """What the page looks like, shape (height, width, 3)."""
    from PIL import Image

    return np.asarray(Image.open(io.BytesIO(page.screenshot())).convert("RGB"), dtype=float)


def near(image, xy, colour, radius=8.0, tolerance=0.15):
    """Count pixels of a colour #rrggbb, however brightly lit, around a point of the page."""
    wanted = np.array([int(colour[i : i + 2], 16) for i in (1, 3, 5)], dtype=float)
    y, x = np.indices(image.shape[:2])
    part = image[np.hypot(x - xy[0], y - xy[1]) <= radius]
    lit = part[part.max(axis=1, initial=0.0) > 60.0]
    hues = lit / np.linalg.norm(lit, axis=1, keepdims=True)
    return int((np.linalg.norm(hues - wanted / np.linalg.norm(wanted), axis=1) < tolerance).sum())
