"""Settings that make no sense are refused, by name and value."""

import math

import pytest

from dreamer_jax.config import ExplorationConfig, LearningConfig, ScheduleConfig

POSITIVE = "must be positive|a standard deviation must be positive"


@pytest.mark.parametrize(
    ("group", "setting", "values", "message"),
    [
        (LearningConfig, "image_std", (0.0, -1.0, math.nan), POSITIVE),
        (LearningConfig, "reward_std", (0.0, -1.0, math.nan), POSITIVE),
        (LearningConfig, "free_nats", (-1.0, math.nan), "must not be negative"),
        (LearningConfig, "kl_scale", (-1.0, math.nan), "must not be negative"),
        (LearningConfig, "entropy_scale", (-0.1, math.nan), "must not be negative"),
        (LearningConfig, "entropy_decay", (0, -1), POSITIVE),
        (ExplorationConfig, "exploration_hold", (0.0, 0.99, math.nan), "at least 1 step"),
        (ScheduleConfig, "supersample", (0, -2), POSITIVE),
    ],
)
def test_a_setting_outside_its_range_is_refused_by_name(group, setting, values, message):
    for value in values:
        with pytest.raises(ValueError, match=rf"{setting} is {value}.*({message})"):
            group(**{setting: value})


def test_an_entropy_that_would_rise_from_nothing_is_refused():
    with pytest.raises(ValueError, match="entropy_scale is 0 and would rise to 0.1"):
        LearningConfig(entropy_scale_end=0.1)
    LearningConfig(entropy_scale_end=0.0)
