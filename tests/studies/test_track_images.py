"""The study of images at torque level: a case each, and how runs are judged."""

import pytest
import track_images as study
from track_images import BELIEVED, LEARNT, Case, Outcome

pytestmark = pytest.mark.study


@pytest.mark.long
@pytest.mark.parametrize(
    "case",
    [
        Case("room", 180.0, "circle"),
        Case("hand", 120.0, "target"),
        # as in test_adaptive_camera.py and test_adaptive_planar_camera.py
        Case("plane", 120.0, "circle"),
    ],
    ids=str,
)
def test_images_are_followed(case):
    outcome = study.run_case(case)
    assert study.shortcomings([outcome]) == []
    assert outcome.largest < 3.0 * outcome.first


def test_what_falls_short_is_said():
    bad = {(5.0, 6.0): 1.5, (7.0, 8.0): 0.5, (11.0, 12.0): 0.5}
    found = study.shortcomings(
        [
            Outcome(Case("room", 60.0, "circle", LEARNT), bad),
            Outcome(Case("room", 60.0, "circle", BELIEVED), bad),
            Outcome(Case("room", 60.0, "target", LEARNT), bad),
            Outcome(Case("room", 60.0, "target", LEARNT), reason="diverged"),
        ]
    )
    assert found[0] == "room, 60°, circle, tracking law, learnt, 0: 1.5 px, 1 wanted"
    assert found[1] == "room, 60°, target, tracking law, learnt, 0: diverged"
    assert len(found) == 4
    assert len(study.cases([0])) > 25
