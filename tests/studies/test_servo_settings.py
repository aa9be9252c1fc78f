"""What the study of visual servoing refuses, and how it reads a target."""

import dataclasses

import numpy as np
import pytest
from numpy.testing import assert_array_equal

import approxjac as aj
from approxjac.studies.servo import ServoResult, ServoSettings, prepare, run


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"law": "7"}, "law '7' not in the settings; valid are 5, 6, ibvs"),
        ({"eye": "x"}, "eye 'x' not in the settings; valid are in-hand, to-hand"),
        ({"gravity": "?"}, "gravity '?' not in the settings; valid are believed, exact"),
        ({"depth_factor": 0.0}, "depth_factor must be a finite number > 0"),
        ({"target": (1.0, 2.0, 3.0), "depth": "measured"}, r"target must have shape \(2,\) \[px\]"),
        ({"target": (1e4, 2.0)}, "target must be within the image of 640 x 480 px"),
    ],
)
def test_bad_settings_are_refused(changes, text):
    with pytest.raises(aj.ApproxJacError, match=text.replace("?", r"\?")):
        prepare("panda", ServoSettings(**changes))


def test_a_target_is_an_image_also_where_depth_is_measured():
    servo = prepare("panda", ServoSettings(depth="measured", target=(300.0, 200.0)))
    assert_array_equal(servo.target[:2], [300.0, 200.0])
    assert servo.target[2] == servo.sensor.value(servo.q_goal)[2]


def test_a_run_that_ends_behind_the_camera_has_not_converged():
    result = run(prepare("panda", ServoSettings(duration=0.2)))
    error = result.run.error.copy()
    error[-1] = np.nan
    lost = ServoResult(result.servo, dataclasses.replace(result.run, error=error))
    assert not lost.converged
    assert np.isnan(lost.final_error)
    assert np.isnan(lost.settling_time)
    assert lost.summary()["final_error_px"] is None
