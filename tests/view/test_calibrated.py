"""Pictures of a calibration show its numbers, and its page holds them."""

import base64
import re
from xml.etree import ElementTree

import numpy as np
import pytest
from numpy.testing import assert_allclose
from tests.calibration.test_calibrate import sockets
from tests.controllers.test_learnt_axes import Arm

import approxjac as aj
from approxjac import view
from approxjac.view.browser.page import policy_of


@pytest.fixture(scope="module")
def found():
    arm = Arm("ur5", 430)
    recordings, apart = sockets(arm, 5, places=2)
    return aj.calibrate(arm.believed, recordings, apart=apart)


def test_residuals_are_those_of_each_place(found):
    ax = view.plot_residuals(found)
    lines = {line.get_label(): line for line in ax.get_lines()}
    for label, name in (
        ("by the drawing", "drawing"), ("fitted", "left"), ("left out of the fit", "held_out"),
    ):  # fmt: skip
        sizes = [1e3 * getattr(each, name) for each in found.places]
        assert_allclose(lines[label].get_xdata(), sizes)
    assert [text.get_text() for text in ax.get_yticklabels()] == ["place 0", "place 1"]


def test_shares_and_deviations_stand_beside_their_numbers(found):
    ax = view.plot_determined(found)
    assert [text.get_text() for text in ax.get_yticklabels()] == list(found.names)
    assert_allclose([bar.get_width() for bar in ax.patches], 100.0 * found.share)
    units = zip(found.sd, found.units, strict=True)
    assert [text.get_text() for text in ax.texts] == [
        f"{1e3 * sd:.2g} m{unit}" for sd, unit in units
    ]
    colors = {
        unit: {
            bar.get_facecolor()
            for bar, each in zip(ax.patches, found.units, strict=True)
            if each == unit
        }
        for unit in ("m", "rad")
    }
    assert colors["m"] != colors["rad"]


@pytest.mark.parametrize(("plane", "rows"), [("xy", [0, 1]), ("xz", [0, 2])])
def test_the_map_has_the_deviations_where_the_tip_is(found, plane, rows):
    ax = view.plot_accuracy(found, plane)
    task = aj.PositionTask(found.robot)
    tips = np.array([task.value(q) for q in found.accuracy.workspace])[:, rows]
    sd = 1e3 * found.accuracy(found.accuracy.workspace)
    (cells,) = ax.collections
    centres, values = np.array(cells.get_offsets()), np.array(cells.get_array())
    nearest = np.array(
        [np.linalg.norm((centres - tip) / np.ptp(tips, axis=0), axis=1).argmin() for tip in tips]
    )
    for k in np.argsort(-np.bincount(nearest))[:20]:  # the fullest cells
        own = sd[nearest == k]
        assert own.min() <= values[k] <= own.max()
    (recorded,) = ax.get_lines()
    seen = np.array([task.value(q) for q in found.accuracy.recorded])[:, rows]
    assert_allclose(np.array(recorded.get_data()).T, seen, atol=1e-9)
    with pytest.raises(aj.errors.UnknownNameError, match="axis 'w' not in plane"):
        view.plot_accuracy(found, "xw")


def test_the_page_is_one_file_with_all_of_it(found, tmp_path):
    path = view.save_calibration_page(found, tmp_path / "report.html")
    text = path.read_text(encoding="utf-8")
    policy = policy_of(text)
    assert "default-src 'none'" in policy
    assert "script-src 'none'" in policy
    assert found.verdict in text
    assert found.coverage in text
    assert str(found).partition("\n\n")[2] in text
    pictures = re.findall(r'<img src="data:image/svg\+xml;base64,([^"]+)" alt="([^"]+)"', text)
    assert len(pictures) == 3
    for data, alt in pictures:
        assert ElementTree.fromstring(base64.b64decode(data)).tag.endswith("svg")
        assert len(alt) > 10
    assert "{{" not in text
    again = view.save_calibration_page(found, tmp_path / "again.html")
    assert again.read_text(encoding="utf-8") == text  # without dates
    with pytest.raises(aj.InvalidInputError, match="calibration must be a Calibration"):
        view.save_calibration_page(None, path)
    with pytest.raises(aj.InvalidInputError, match="path must be a file that can be written"):
        view.save_calibration_page(found, tmp_path)


@pytest.mark.browser
def test_a_browser_shows_its_pictures(found, tmp_path, open_page):
    page = open_page(view.save_calibration_page(found, tmp_path / "report.html"))
    widths = page.locator("img").evaluate_all("all => all.map((i) => i.naturalWidth)")
    assert len(widths) == 3
    assert min(widths) > 300
