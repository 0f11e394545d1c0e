"""A training that finds nothing is noticed; one that has nothing to find is left alone."""

from __future__ import annotations

from nerif.reconstruction.neural.watch import LEAST, PATIENCE, RATE, Watch


def followed(values: list[float], noise: float = 0.0, rate: float = RATE) -> Watch:
    watch = Watch(noise, rate)
    for step, q in enumerate(values, start=1):
        watch.follow(2 * q, 2.0, step)
    return watch


def test_an_empty_field_is_noticed_after_a_while_or_at_the_end():
    assert not followed([1.0] * (LEAST - 1)).collapsed(over=True)
    assert followed([1.0] * LEAST).collapsed(over=True)
    assert not followed([1.0] * (PATIENCE - 1)).collapsed(over=False)
    assert followed([1.0] * PATIENCE).collapsed(over=False)


def test_a_smaller_learning_rate_has_more_steps_to_leave_the_empty_field():
    assert not followed([1.0] * (4 * PATIENCE - 1), rate=RATE / 4).collapsed(over=False)
    assert followed([1.0] * 4 * PATIENCE, rate=RATE / 4).collapsed(over=False)
    assert followed([1.0] * PATIENCE, rate=4 * RATE).collapsed(over=False)


def test_a_field_that_is_lost_again_is_noticed_soon():
    found = [0.1] * 100
    assert not followed(found).collapsed(over=True)
    lost = followed([*found, *[0.8] * 60])
    assert lost.collapsed(over=False)
    assert not lost.healthy
    assert followed(found).healthy


def test_noise_alone_and_no_displacement_are_nothing_to_find():
    assert not followed([1.0] * PATIENCE, noise=0.95).collapsed(over=True)
    still = Watch(0.0)
    for step in range(PATIENCE):
        still.follow(0.1, 0.0, step)
    assert not still.collapsed(over=True)
    # half of what was measured is noise, and the other half is explained
    assert followed([0.52] * PATIENCE, noise=0.5).left < 0.1


def test_looking_now_and_then_is_as_good():
    watch = Watch(0.0)
    for step in range(20, PATIENCE + 1, 20):
        watch.follow(1.0, 1.0, step)
    assert watch.collapsed(over=False)


def test_what_is_found_in_part_is_said():
    assert "70%" in followed([0.7] * PATIENCE).remark
    assert followed([0.2] * PATIENCE).remark == ""


def test_a_residual_well_above_the_noise_is_said():
    assert "the residual is 2.0 sigma" in followed([0.04] * PATIENCE, noise=0.01).remark
    assert followed([0.012] * PATIENCE, noise=0.01).remark == ""
    assert followed([0.04] * PATIENCE).remark == ""  # where sigma is not known
