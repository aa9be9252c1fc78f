"""The certificate of the sampled loop, attacked."""

import attack_certificate as study
import numpy as np
import pytest


def test_what_contradicts_is_reported():
    fine = study.nothing("panda, PositionTask, setup 1")
    assert not fine.counterexamples()
    broken = fine._replace(
        latency=study.Latency(), growth=np.array([1.01]), rises=[1e-3], uneven=[1e-3],
        diverged=1,
    )  # fmt: skip
    assert len(broken.counterexamples()) == 4
    assert "Counterexamples: 4." in study.table([fine, broken])


@pytest.mark.long
@pytest.mark.parametrize(
    "numbers",
    [range(7, 8), range(11), range(11, 22)],
    ids=lambda numbers: f"{numbers.start} to {numbers.stop - 1}",
)
def test_nothing_contradicts_the_certificates_of_other_setups(monkeypatch, numbers):
    monkeypatch.setattr(study, "INNER", 6)  # so few are traced once, and half as many as by hand
    outcomes, share = [study.attack((number, 7, 200)) for number in numbers], len(numbers) / 11.0
    assert sum(o.latency is not None for o in outcomes) >= 5 * share
    assert not [text for o in outcomes for text in o.counterexamples()]
    assert sum(len(o.uneven) for o in outcomes) >= 10 * share
    assert "Counterexamples: 0." in study.table(outcomes)
