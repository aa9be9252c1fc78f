"""Which families certify stable two-link targets: each holds those before it, K misses none."""

import families
import numpy as np
import pytest
from numpy.testing import assert_allclose

from approxjac import law
from approxjac.stability.certificates.matrix_form import FAMILIES

pytestmark = pytest.mark.study


@pytest.mark.parametrize("number", [0, 1, 2, 3])
def test_the_form_with_k_is_lyapunovs_equation_at_a_target(number):
    """V̇ = −zᵀQz with the Q that the equation was solved for."""
    closed, q = families.draw(number)
    target, setting = closed.plants[0].sensor.value(q)[None], closed.setting
    at = closed.samples_at(np.zeros(1, dtype=int), q[None], target)
    if not families.is_stable(at, setting):
        pytest.skip("not stable")
    form, found = families.AtRest(at, setting), families.of_lyapunov(at, setting)
    Q = form.pencils(found)[0][0, 0]
    wanted = np.zeros((4, 4))
    wanted[:2, :2] = law.dissipation(at.J_hat[0], setting.kv, setting.B)
    wanted[2:, 2:] = np.diag(setting.kp)
    share = Q[0, 0] / wanted[0, 0]
    assert share > 0.0
    assert_allclose(Q, share * wanted, atol=1e-7 * np.abs(Q).max())


@pytest.mark.long
def test_each_family_holds_those_before_it():
    outcomes = [families.run_case(number) for number in range(6)]
    stable = [o.at_target for o in outcomes if o.at_target is not None]
    assert len(stable) >= 4
    for found in stable:
        verdicts = [found[name] for name in FAMILIES]
        assert verdicts == sorted(verdicts)
        assert found["Lyapunov"]
    table = families.table(outcomes)
    assert f"| at the target | {len(stable)} |" in table
    assert f"| {len(stable)} (100.0 %) |" in table
