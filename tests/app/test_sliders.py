"""Steps of sliders and what they stand for."""

from __future__ import annotations

import pytest

from nerif.app.forms.sliders import STEPS, SliderScale
from nerif.app.pages.design import SLIDERS


@pytest.mark.parametrize("ends", [e for e in SLIDERS.values() if isinstance(e[0], float)])
def test_every_step_stands_for_a_number_of_its_own(ends):
    scale = SliderScale(*ends)
    values = [scale.value(step) for step in range(scale.last + 1)]
    assert (values[0], values[-1]) == ends
    assert values == sorted(set(values))
    assert [scale.step(value) for value in values] == list(range(scale.last + 1))


def test_decades_are_as_wide_as_one_another():
    scale = SliderScale(1e-6, 1e-4)
    assert scale.logarithmic
    assert scale.value(STEPS // 2) == pytest.approx(1e-5)
    assert scale.step(0.0) == 0
    assert scale.step(1.0) == STEPS


def test_a_short_way_and_whole_numbers_are_linear():
    assert SliderScale(10.0, 50.0).value(STEPS // 2) == 30.0
    whole = SliderScale(1, 24, whole=True)
    assert [whole.value(step) for step in range(whole.last + 1)] == list(range(1, 25))
    assert whole.step(7) == 6
