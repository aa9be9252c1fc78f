"""The certificate of the loop as it runs, attacked: a small part by default."""

import attack_certificate as study
import numpy as np
import pytest

SMALL = {"SAMPLES": 24, "SHARES": (0.3,), "INNER": 3, "OF_EACH": 2, "RECORDED": 1, "STEPS": 150}


@pytest.fixture
def small(monkeypatch):
    for name, value in SMALL.items():
        monkeypatch.setattr(study, name, value)
    monkeypatch.setattr(study, "LONGEST", 200)


def test_nothing_contradicts_a_few_certificates(small):
    outcomes = [study.attack((number, 5, 16)) for number in (0, 7, 10, 11)]
    assert all(o.latency and o.radius > 0.0 for o in outcomes)
    assert not [text for o in outcomes for text in o.counterexamples()]
    assert "Counterexamples: 0." in study.table(outcomes)


def test_what_contradicts_is_told(small):
    fine = study.nothing("panda, PositionTask, setup 1")
    assert not fine.counterexamples()
    broken = fine._replace(
        latency=study.Latency(), growth=np.array([1.01]), rises=[1e-3], diverged=1, left=2
    )
    assert len(broken.counterexamples()) == 4
    assert "Counterexamples: 4." in study.table([fine, broken])


@pytest.mark.study
def test_nothing_contradicts_the_certificates_of_other_setups():
    outcomes = [study.attack((number, 7, 200)) for number in range(22)]
    assert sum(o.latency is not None for o in outcomes) >= 10
    assert not [text for o in outcomes for text in o.counterexamples()]
