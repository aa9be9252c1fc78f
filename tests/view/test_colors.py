"""Colours that people with colour-blindness can tell apart, by computation."""

from itertools import combinations

import numpy as np
import pytest

from approxjac import view

ROLES = ("true", "believed", "target", "neutral", "saturated", "at_limit", "force")
# Full dichromacy, on linear RGB: Machado, Oliveira, Fernandes (2009), "A physiologically-based
# model for simulation of color vision deficiency", IEEE TVCG 15 (6), severity 1.0.
EYES = {
    "usual": np.eye(3),
    "protanopia": np.array(
        [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216],
         [-0.003882, -0.048116, 1.051998]]
    ),
    "deuteranopia": np.array(
        [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413],
         [-0.011820, 0.042940, 0.968881]]
    ),
    "tritanopia": np.array(
        [[1.255528, -0.076749, -0.178779], [-0.078411, 0.930809, 0.147602],
         [0.004733, 0.691367, 0.303900]]
    ),
}  # fmt: skip
XYZ = np.array(  # of linear sRGB, IEC 61966-2-1, white D65
    [[0.4124564, 0.3575761, 0.1804375], [0.2126729, 0.7151522, 0.0721750],
     [0.0193339, 0.1191920, 0.9503041]]
)  # fmt: skip
# Okabe and Ito's own closest pair has 15.9 here (green and sky blue, tritanopia); a difference
# that one just notices is 2.3.
APART = 15.5


def lab(color, eyes):
    """CIELAB of a colour "#rrggbb" as some eyes see it."""
    coded = np.array([int(color[i : i + 2], 16) for i in (1, 3, 5)]) / 255.0
    linear = np.where(coded <= 0.04045, coded / 12.92, ((coded + 0.055) / 1.055) ** 2.4)
    share = XYZ @ np.clip(EYES[eyes] @ linear, 0.0, 1.0) / XYZ.sum(axis=1)
    f = np.where(share > (6 / 29) ** 3, np.cbrt(share), share / (3 * (6 / 29) ** 2) + 4 / 29)
    return np.array([116 * f[1] - 16, 500 * (f[0] - f[1]), 200 * (f[1] - f[2])])


def closest(colors, eyes):
    """Smallest CIE76 difference of any two colours."""
    return min(np.linalg.norm(lab(a, eyes) - lab(b, eyes)) for a, b in combinations(colors, 2))


@pytest.mark.parametrize("eyes", EYES)
def test_any_two_colors_are_told_apart(eyes):
    meant = {view.COLORS[role] for role in ROLES}
    assert len(set(view.SERIES)) == 8  # the corners of a tag are eight coordinates
    assert closest(sorted(meant | set(view.SERIES)), eyes) > APART


def test_the_computation_is_right_and_finds_bad_colors():
    assert lab("#ffffff", "usual") == pytest.approx([100.0, 0.0, 0.0], abs=1e-3)
    assert lab("#ff0000", "usual") == pytest.approx([53.24, 80.09, 67.20], abs=0.02)
    red_and_green = ("#d62728", "#2ca02c")  # of Matplotlib's own cycle
    assert closest(red_and_green, "usual") > 3 * APART
    assert closest(red_and_green, "deuteranopia") < APART
    for eyes, grey in EYES.items():  # rows sum to one: what has no hue has none
        assert grey.sum(axis=1) == pytest.approx(1.0, abs=2e-6), eyes


def test_each_colour_has_one_meaning_and_is_seen_on_white():
    colors = [view.COLORS[role] for role in ROLES]
    assert len(set(colors)) == len(ROLES)
    for color in (*colors, *view.SERIES):
        assert closest((color, "#ffffff"), "usual") > 3 * APART
