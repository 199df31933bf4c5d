"""Physical gains become mantissas and shifts, or a clear refusal."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from firmware_py import tuning
from firmware_py.kernel import layout as k
from firmware_py.tuning import AdrcTuning, LimiterTuning, PiTuning, Tuning, TuningError


def stored_gain(calibration, index):
    return calibration.words[index] * 2.0 ** -calibration.words[index + 1]


def test_papers_gains_in_the_kernels_units():
    calibration = Tuning().calibration()
    u_per_position = 2.0**-31 / 2.0**-20
    assert stored_gain(calibration, k.CAL_P_KP) == pytest.approx(31_100 * u_per_position, rel=1e-9)
    assert stored_gain(calibration, k.CAL_PI_KP) == pytest.approx(27_270 * u_per_position, rel=1e-9)
    assert stored_gain(calibration, k.CAL_PI_KI) == pytest.approx(39.9 * u_per_position, rel=1e-9)
    assert stored_gain(calibration, k.CAL_ESO_BETA1) == pytest.approx(4 * 200e-3, rel=1e-9)
    assert stored_gain(calibration, k.CAL_ESO_BETA4) == pytest.approx(0.2**4 * 2**11, rel=1e-9)
    assert stored_gain(calibration, k.CAL_ESO_A1) == pytest.approx(-5e4 * 1e-6 * 4, rel=1e-9)
    assert stored_gain(calibration, k.CAL_FB_K1) == pytest.approx(180**3 / 70 * u_per_position, rel=1e-9)
    assert stored_gain(calibration, k.CAL_LEAD_V1) * 2**7 == pytest.approx(10.0)
    assert calibration.words[k.CAL_ESO_DELTA] == round(1e-4 * 2**31)
    assert calibration.words[k.CAL_ESO_A2] == 0


@given(kp=st.floats(1e-3, 1e9))
def test_a_gain_is_stored_to_one_part_in_a_million(kp):
    calibration = Tuning(p=PiTuning(kp)).calibration()
    assert stored_gain(calibration, k.CAL_P_KP) == pytest.approx(kp * 2.0**-11, rel=1e-6)


@pytest.mark.parametrize(
    ("refused", "message"),
    [
        (Tuning(p=PiTuning(1e11)), "tuning: CAL_P_KP = 4.88281e.07 exceeds 8.38861e.06"),
        (Tuning(p=PiTuning(1e-15)), "tuning: CAL_P_KP = 4.88281e-19 is too small for 31 bits at shift 62"),
        (Tuning(p=PiTuning(float("nan"))), "tuning: CAL_P_KP = nan is not finite"),
        (Tuning(p=PiTuning(1.0, 1.0)), "tuning: the P law has no integral gain"),
        (Tuning(adrc=AdrcTuning(b0_m_s2_per_rad=0.0)), "tuning: b0 = 0.0 must be positive"),
        (Tuning(adrc=AdrcTuning(h0_s=0.02)), "tuning: CAL_TD_D = 0.01 outside 5.82077e-11..0.00195312"),
        (Tuning(adrc=AdrcTuning(eso_delta_m=1e-11)), "tuning: CAL_ESO_DELTA = 1e-11 outside 4.65661e-10..1"),
        (Tuning(limiter=LimiterTuning(speed_m_s=10.0)), "tuning: CAL_LIMITER_RATE = "),
        (Tuning(speed_limit_rpm=20_000), "tuning: CAL_U_LIMIT = 2094.4 outside"),
    ],
)
def test_an_unrepresentable_gain_is_refused_in_one_line(refused, message):
    with pytest.raises(TuningError, match=message) as caught:
        refused.calibration()
    assert "\n" not in str(caught.value)


def test_the_named_tunings():
    named = (tuning.P, tuning.PI, tuning.PI_STAR)
    assert named == (PiTuning(31_100.0, 0.0), PiTuning(27_270.0, 39_900.0), PiTuning(20_853.0, 513_300.0))
